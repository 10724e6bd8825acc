"""What hangs on a reconstruction by little is placed by itself, or in no map."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.geometry.camera import Camera
from ingest.clusters.reconstruct import Reconstruction
from ingest.colmap.bridge import Model
from ingest.map_builder import MapIdentity
from ingest.photos.photo import Photo
from ingest.placed_models import Component, impossible_lens, impossible_shear, place_models
from ingest.reconstruction import MapMakingOptions, Reconstructed
from ingest.register.gps import GpsPlacement
from ingest.sfm.extract import FeatureFiles
from tests.support.growth_box import existing
from tests.support.posed_models import model_of


@dataclass(frozen=True, slots=True, kw_only=True)
class _Made(Reconstruction):
    model: Model

    def models(self) -> Iterator[Model]:
        yield self.model


@pytest.fixture(autouse=True)
def _no_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The models here are ties without geometry, of which no map can be built."""
    monkeypatch.setattr("ingest.placed_models.build_unplaced_map", lambda *_: None)


def _identity(number: int) -> MapIdentity:
    return MapIdentity(map_id=f"map-{number}", name=f"map {number}", source="", licence="", provenance={})


def _placed(model: Model, options: MapMakingOptions | None = None) -> list[Component]:
    photos = [
        Photo(name=f"{k}.jpg", path=Path(f"{k}.jpg"), width=640, height=480, sha256=f"{k:02}")
        for k in range(len(model.rows))
    ]
    done = Reconstructed(
        usable=tuple(photos),
        features=FeatureFiles(tuple(p.path for p in photos)),
        reconstruction=_Made(model=model),
    )
    return list(place_models(done, options or MapMakingOptions(), identity=_identity))


def _said(components: list[Component]) -> list[tuple[str, list[str]]]:
    return [(c.reason_code, [p.name.removesuffix(".jpg") for p in c.photos]) for c in components]


def test_photos_that_little_ties_are_in_no_map() -> None:
    one = range(200)
    tied = model_of(one, one, one, range(170, 300), range(171, 200))
    assert _said(_placed(tied)) == [("TOO_FEW", ["0", "1", "2", "3"]), ("WEAKLY_TIED", ["4"])]


def test_two_houses_that_little_ties_are_two_maps() -> None:
    one, other = range(200), range(171, 371)
    model = model_of(one, one, one, other, other, other)
    parts = _placed(model)
    assert _said(parts) == [("TOO_FEW", ["0", "1", "2"]), ("TOO_FEW", ["3", "4", "5"])]
    assert [len(c.model.xyz) for c in parts] == [200, 200]
    # With as many points in common as are asked for they are one.
    (whole,) = _placed(model, MapMakingOptions(min_tie=29))
    assert whole.model is model


def test_a_part_that_was_joined_wrongly_is_placed_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked of the whole first, then of what is left and of the part, which are right."""
    asked: list[int] = []

    def joined_wrongly(model: Model, *_: object) -> list[list[int]]:
        asked.append(len(model.rows))
        return [[2, 3, 4]] if len(model.rows) == 6 else []

    accepted = GpsPlacement(reason=None, message="", residuals_m=np.zeros((0, 3)), inliers=np.zeros(0, bool))

    def component(model: Model, photos: Sequence[Photo], *_: object) -> Component:
        chosen = tuple(photos[r] for r in model.rows)
        return Component(model=model, photos=chosen, with_gps=(), placement=accepted, feature_map=None)

    monkeypatch.setattr("ingest.register.tagged_elsewhere.joined_wrongly", joined_wrongly)
    for module in ("placed_models", "register.tagged_elsewhere"):
        monkeypatch.setattr(f"ingest.{module}.tagged_elsewhere", lambda *_: [])
    monkeypatch.setattr("ingest.placed_models.placed_by_gps", lambda *_: (None, (), accepted))
    monkeypatch.setattr("ingest.placed_models._component", component)
    one = range(200)
    parts = _placed(model_of(*([one] * 6)))
    assert asked == [6, 3, 3]
    assert [[p.name.removesuffix(".jpg") for p in c.photos] for c in parts] == [
        ["0", "1", "5"],
        ["2", "3", "4"],
    ]


def test_photos_that_are_too_few_for_a_map_are_named_together() -> None:
    one = range(200)
    model = model_of(one, one, one, range(180, 400), range(300, 400), range(10))
    assert _said(_placed(model)) == [("TOO_FEW", ["0", "1", "2"]), ("WEAKLY_TIED", ["3", "4", "5"])]


@pytest.mark.parametrize(
    ("focal_px", "shear", "word"),
    [(1265.0, 0.0, "wrong EXIF"), (1265.0, 3e-4, "sheared"), (None, 0.0, ""), (420.0, 0.0, "")],
)
def test_a_focal_length_that_cannot_be_holds_a_map_back(
    focal_px: float | None, shear: float, word: str
) -> None:
    """A rolling shutter bent a map until its lens was a fifth of EXIF's; a picture may be cut by a third."""
    model = model_of(range(200), range(200), range(200))
    model = replace(model, cameras=tuple(Camera.from_focal(640, 480, 262.0) for _ in model.cameras))
    photos = [Photo(name=f"{k}.jpg", path=Path(f"{k}.jpg"), focal_px=focal_px) for k in range(3)]
    reason = impossible_lens(model, photos, shear)
    assert word in reason
    assert ("EXIF says 1265" in reason) == bool(reason) == bool(word)


@pytest.mark.parametrize(("size", "held"), [(9e-4, True), (1e-4, False), (None, False)])
def test_pictures_sheared_as_no_lens_shears_them_hold_a_map_back(size: float | None, held: bool) -> None:
    feature_map = existing()
    told = {} if size is None else {"picture_shear": size}
    reason = impossible_shear(replace(feature_map, provenance=told), np.zeros(8, dtype=np.int64))
    assert ("rolling shutter" in reason) == held
    assert bool(reason) == held
    assert impossible_shear(replace(feature_map, provenance=told), np.arange(8)) == ""
