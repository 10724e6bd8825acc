"""What evidence says of a photo goes with it."""

from dataclasses import replace

from featuredb.export.selection import forget, licensed, names_of
from tests.support.maps import random_map


def test_members_elements_and_words_that_name_a_photo_go() -> None:
    names = {"flight/1.jpg", "1.jpg"}
    evidence = {
        "residuals_m": {"flight/1.jpg": [0.1], "flight/11.jpg": [0.2]},
        "outliers": ["flight/1.jpg", "flight/11.jpg"],
        "frames": [{"image": "1.jpg", "m": 1.0}, {"image": "11.jpg", "m": 2.0}],
        "worst": "1.jpg",
        "note": "flight/1.jpg is off by 3 m, and 11.jpg, too; 1.jpg.",
        "figures": [1, None, True, 0.5],
    }
    assert forget(evidence, names) == {
        "residuals_m": {"flight/11.jpg": [0.2]},
        "outliers": ["flight/11.jpg"],
        "frames": [{"image": "11.jpg", "m": 2.0}],
        "note": "(left out) is off by 3 m, and 11.jpg, too; (left out).",
        "figures": [1, None, True, 0.5],
    }
    assert forget(evidence, ()) == evidence


def test_a_map_by_licence_does_not_name_the_others() -> None:
    whole = random_map(3)
    gone, kept = whole.images[1], whole.images[0]
    evidence = {
        "residuals": {i.name: 1.0 for i in whole.images},
        "used": [gone.sha256[:32], kept.sha256[:32]],
    }
    images = tuple(replace(i, licence="proprietary") if i is gone else i for i in whole.images)
    whole = replace(
        whole,
        images=images,
        placement=replace(whole.placement, evidence=evidence),
        provenance={"photos": [gone.name, kept.name]},
    )
    part = licensed(whole, ("cc-by",))
    assert part is not None
    assert gone.name not in part.placement.evidence["residuals"]
    assert len(part.placement.evidence["residuals"]) == 3
    assert part.placement.evidence["used"] == [kept.sha256[:32]]
    assert part.provenance["photos"] == [kept.name]


def test_a_name_that_a_kept_photo_has_too_stays() -> None:
    """Two folders may hold files of one name: what is said of `a.jpg` may be about the one that is kept."""
    images = random_map(1).images
    one, other = replace(images[0], name="x/a.jpg"), replace(images[1], name="y/a.jpg")
    assert names_of([one]) - names_of([other]) == {"x/a.jpg", one.sha256, one.sha256[:32]}
