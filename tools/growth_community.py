"""Twelve people's photos of a town that a survey has mapped in part: how many register, and how well?

The world is that of `tools.worlds.community`: geotags with 30 m of error per axis, a tenth of them
wrong by kilometres; another town's photos, re-uploads, rooms and faces among them. The survey is ingested
with the accuracy of its receiver. All other photos are contributed and grown at once. A few landmarks have
most of the photos, as on photo sites.
"""

from collections.abc import Sequence

from tools.figures import median
from tools.growth_common import Album, Registered, Verdict, conclude, surveyed
from tools.worlds.community import CommunityOptions, community_album

_OWN = ("street", "drone")
_FOREIGN = ("other_town", "indoor", "portrait")
_SHARE, _MEDIAN_M = 0.70, 0.30


def main() -> None:
    args, _, study = surveyed(__doc__, CommunityOptions, community_album)
    study.give(study.album.of(*_OWN, *_FOREIGN, "copy"))
    waiting = study.grown()
    conclude(args.json, judge(study.album, study.registered()), waiting["FAILED"])


def judge(album: Album, found: Sequence[Registered]) -> list[Verdict]:
    """The contract's line, from photos in active maps."""
    own = album.of(*_OWN)
    active = [r for r in found if r.status == "active" and r.generation > 0]
    mine = [r for r in active if r.fact.kind in _OWN]
    foreign = [r for r in active if r.fact.kind in _FOREIGN]
    wrong = [r for r in active if r.wrong]
    # Of a picture and its re-upload one is taken; it does not matter which.
    pictures = {r.fact.name for r in mine} | {r.fact.copy_of for r in active if r.fact.kind == "copy"}
    share = len(pictures & {f.name for f in own}) / max(len(own), 1)
    errors = [r.error_m for r in mine]
    middle, worst = median(errors), max(errors, default=float("nan"))
    return [
        Verdict(
            "registered",
            f"{share:.1%} of {len(own)} photos of the town, {_SHARE:.0%} wanted",
            share >= _SHARE,
        ),
        Verdict(
            "median error",
            f"{middle:.3f} m, at most {_MEDIAN_M} m wanted; worst {worst:.2f} m",
            middle <= _MEDIAN_M,
        ),
        Verdict(
            "foreign photos",
            f"{len(foreign)} of {len(album.of(*_FOREIGN))} admitted, none wanted",
            not foreign,
        ),
        Verdict("wrong by more than 2 m", f"{len(wrong)}, none wanted", not wrong),
    ]


if __name__ == "__main__":
    main()
