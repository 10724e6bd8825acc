"""Photos that hang on others by little are told from those that hang together."""

import numpy as np

from ingest.colmap.bridge import Model
from ingest.growth.place.component import split
from ingest.sfm.links import bottleneck_share, connected_parts
from tests.support.posed_models import model_of


def test_the_weakest_link_of_the_firmest_chain_counts() -> None:
    # 0 is held, 1 shares half of its points with it; 2 and 3 share all but hang on 1 by 4 of 100.
    model = model_of(range(100), range(50, 150), range(146, 246), range(146, 246))
    firm = bottleneck_share(model, [0])
    assert firm[0] == np.inf
    np.testing.assert_allclose(firm[1:], [0.5, 0.04, 0.04])
    # Held at both ends the same photos hang well.
    np.testing.assert_allclose(bottleneck_share(model, [0, 3])[1:3], [0.5, 1.0])


def test_a_photo_of_few_points_hangs_by_its_own_share() -> None:
    model = model_of(range(1000), range(980, 1020))
    np.testing.assert_allclose(bottleneck_share(model, [0])[1], 0.5)


def test_photos_without_a_chain_hang_on_nothing() -> None:
    model = model_of(range(100), range(200, 300))
    assert bottleneck_share(model, [0])[1] == 0.0
    assert (bottleneck_share(model, []) == 0.0).all()


def two_places() -> Model:
    """Photos 0 to 2 share half of their points, so do 3 to 6; 12 of a hundred tie 2 to 3."""
    return model_of(
        *(range(50 * k, 50 * k + 100) for k in range(2)),
        [*range(100, 188), *range(1000, 1012)],
        [*range(1000, 1012), *range(1012, 1100)],
        *(range(1050 + 50 * k, 1150 + 50 * k) for k in range(3)),
    )


def test_parts_are_tied_by_less_than_their_photos_are() -> None:
    model = two_places()
    assert connected_parts(model, 0.10) == [[0, 1, 2, 3, 4, 5, 6]]
    assert connected_parts(model, 0.15) == [[3, 4, 5, 6], [0, 1, 2]]
    assert connected_parts(model, 0.60) == [[k] for k in range(7)]


def test_a_reconstruction_of_two_places_is_taken_apart_at_its_weakest_joint() -> None:
    model = two_places()
    level, parts = split(model, (0.10, 0.15, 0.25))
    assert level == 0.15
    assert [part.rows.tolist() for part in parts] == [[3, 4, 5, 6], [0, 1, 2]]
    # Points that only the joint had two views of are gone.
    assert len(parts[1].xyz) == 100
    # One place is left as it is, and so are links that nobody names.
    assert split(parts[0], (0.10, 0.15, 0.25)) == (0.0, [])
    assert split(model, ()) == (0.0, [])
    # Photos that hang on nothing are in no part.
    assert split(model, (0.60,)) == (0.60, [])
