"""Photos that hang on others by little are told from those that hang together."""

import numpy as np

from ingest.growth.links import firmness
from tests.support.posed_models import model_of


def test_the_weakest_link_of_the_firmest_chain_counts() -> None:
    # 0 is held, 1 shares half of its points with it; 2 and 3 share all but hang on 1 by 4 of 100.
    model = model_of(range(100), range(50, 150), range(146, 246), range(146, 246))
    firm = firmness(model, [0])
    assert firm[0] == np.inf
    np.testing.assert_allclose(firm[1:], [0.5, 0.04, 0.04])
    # Held at both ends the same photos hang well.
    np.testing.assert_allclose(firmness(model, [0, 3])[1:3], [0.5, 1.0])


def test_a_photo_of_few_points_hangs_by_its_own_share() -> None:
    model = model_of(range(1000), range(980, 1020))
    np.testing.assert_allclose(firmness(model, [0])[1], 0.5)


def test_photos_without_a_chain_hang_on_nothing() -> None:
    model = model_of(range(100), range(200, 300))
    assert firmness(model, [0])[1] == 0.0
    assert (firmness(model, []) == 0.0).all()
