"""What becomes of a folder of photos whose positions nobody knows: maps, and photos in them.

The folder is ingested into a new database.
Prints how many photos are in the largest map, in any map, and in how many, placed or not, and
what the placement of the first leaves between positions and the map (of --gcp: ground control points, of
which no other position is known).
"""

from pathlib import Path

from tools.commands import make
from tools.figures import study_parser, write_figures
from tools.photo_files import photo_names


def main() -> None:
    parser = study_parser(__doc__, "--photos", "--work")
    parser.add_argument("--gcp", type=Path, default=None, metavar="FILE", help="control points of the photos")
    args = parser.parse_args()
    control = () if args.gcp is None else ("--gcp", str(args.gcp))
    made = make(args.work / "db", "photos", args.photos, control)
    write_figures(args.json, made | {"photos": len(photo_names(args.photos))})


if __name__ == "__main__":
    main()
