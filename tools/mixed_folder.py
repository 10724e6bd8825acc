"""Photos of several places and people in one folder, as a community brings them: which maps come of them.

All photos are linked into one folder and ingested at once. Folders of the same PLACE may share a map; a map
with photos of two places is wrong. Prints how many photos each map has and of where.
"""

from collections import Counter
from pathlib import Path

from tools.commands import all_maps, make
from tools.figures import say, study_parser, write_figures
from tools.photo_files import photo_names


def main() -> None:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("sets", nargs="+", metavar="PLACE=FOLDER")
    args = parser.parse_args()
    together: Path = args.work / "photos"
    together.mkdir(parents=True, exist_ok=True)
    place_of = {}
    for number, (place, folder) in enumerate(one.split("=", 1) for one in args.sets):
        for name in photo_names(Path(folder)):
            link = together / f"{number:02d}-{name}"
            place_of[link.name] = place
            if not link.is_symlink():
                link.symlink_to((Path(folder) / name).resolve())
    made = make(args.work / "db", "photos", together)
    maps = [Counter(place_of[image.name] for image in one.images) for one in all_maps(args.work / "db")]
    for one in sorted(maps, key=lambda found: -found.total()):
        say(", ".join(f"{count} of {place}" for place, count in one.items()))
    largest = {place: max((one[place] for one in maps), default=0) for place in place_of.values()}
    figures = {
        "photos": len(place_of),
        "places": len(largest),
        "mixed": sum(len(one) > 1 for one in maps),
        "in_largest": sum(largest.values()),
        "least_share": min(largest[p] / n for p, n in Counter(place_of.values()).items()),
    }
    write_figures(args.json, made | figures)


if __name__ == "__main__":
    main()
