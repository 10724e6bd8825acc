"""What becomes of photos of one place or of several, as a community brings them: maps, and photos in them.

The photos of all folders are linked into one, which is ingested into a new database. Prints how many photos
are in the largest map, in any map, and in how many, placed or not, and what the placement of the first leaves
between positions and the map (of --gcp: ground control points, of which no other position is known). Folders
of the same PLACE may share a map; a map with photos of two places is wrong. Prints how many photos each map
has and of where.
"""

from collections import Counter
from pathlib import Path

from tools.commands import all_maps, make
from tools.figures import say, study_parser, write_figures
from tools.photo_files import photo_names


def main() -> None:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("sets", nargs="+", metavar="PLACE=FOLDER")
    parser.add_argument("--gcp", type=Path, metavar="FILE", help="control points of the first folder")
    args = parser.parse_args()
    together: Path = args.work / "photos"
    together.mkdir(parents=True, exist_ok=True)
    place_of = {}
    for number, (place, folder) in enumerate(one.split("=", 1) for one in args.sets):
        for name in photo_names(Path(folder)):
            # Control points name the photos of the first folder as they are called there.
            link = together / (f"{number:02d}-{name}" if number else name)
            place_of[link.name] = place
            if not link.is_symlink():
                link.symlink_to((Path(folder) / name).resolve())
    control = () if args.gcp is None else ("--gcp", str(args.gcp))
    made = make(args.work / "db", "photos", together, control)
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
