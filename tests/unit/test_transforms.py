"""Rigid3, Sim3 and the array checks: what they refuse, and values known by hand."""

import dataclasses
import pickle

import numpy as np
import pytest

from featuredb.errors import FeatureDbError, InvalidValueError
from featuredb.geometry.arrays import frozen_array
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, nearest_rotation, rotation_angle
from featuredb.geometry.sim3 import Sim3

QUARTER_TURN_ABOUT_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def test_rigid_moves_a_known_point() -> None:
    target_from_source = Rigid3(rotation=QUARTER_TURN_ABOUT_Z, translation=np.array([10.0, 20.0, 30.0]))
    np.testing.assert_allclose(target_from_source.act([1.0, 2.0, 3.0]), [8.0, 21.0, 33.0])
    np.testing.assert_allclose(target_from_source.act(target_from_source.center), np.zeros(3), atol=1e-12)
    assert target_from_source.angle_to_deg(Rigid3.identity()) == pytest.approx(90.0)


def test_quarter_turn_quaternion_by_hand() -> None:
    half = np.sqrt(0.5)
    np.testing.assert_allclose(matrix_from_quaternion([0, 0, half, half]), QUARTER_TURN_ABOUT_Z, atol=1e-15)
    rigid = Rigid3.from_quaternion([0, 0, -half, -half], [1, 2, 3])
    np.testing.assert_allclose(rigid.rotation, QUARTER_TURN_ABOUT_Z, atol=1e-15)
    np.testing.assert_allclose(rigid.quaternion_xyzw, [0, 0, half, half], atol=1e-15)


def test_screw_motion_exponential_by_hand() -> None:
    # Half a turn about z while moving 2 pi along x traces a half circle of radius 2: it ends at y = 4.
    screw = Rigid3.exp([0, 0, np.pi, 2 * np.pi, 0, 5])
    np.testing.assert_allclose(screw.translation, [0.0, 4.0, 5.0], atol=1e-12)


@pytest.mark.parametrize("angle", [1e-9, 1e-7, 1e-6, 2e-6, 1e-5, 1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("sigma", [0.0, 1e-13, 1e-9, 1e-7, 2e-5, 1e-4, 0.1])
def test_small_tangents_lose_no_digits(angle: float, sigma: float) -> None:
    # The power series W = sum A^n / (n + 1)! has no cancellation for small A; the closed forms could have.
    omega = angle * np.array([0.6, -0.48, 0.64])
    x, y, z = omega
    a = sigma * np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    series, power = np.eye(3), np.eye(3)
    for n in range(1, 30):
        power = power @ a / (n + 1)
        series = series + power
    nu = np.array([3e5, -2e5, 1e5])
    expected = series @ nu
    np.testing.assert_allclose(Sim3.exp([sigma, *omega, *nu]).translation, expected, rtol=0, atol=1e-9)
    if sigma == 0.0:
        np.testing.assert_allclose(Rigid3.exp([*omega, *nu]).translation, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, -1.0, 0], [0.6, 0, 0.8]])
def test_half_turn_survives_log(axis: list[float]) -> None:
    omega = np.pi * np.array(axis)
    rigid = Rigid3.exp([*omega, 1.0, 2.0, 3.0])
    again = Rigid3.exp(rigid.log())
    np.testing.assert_allclose(again.matrix(), rigid.matrix(), atol=1e-9)
    assert rotation_angle(rigid.rotation) == pytest.approx(np.pi, abs=1e-7)


def test_similarity_moves_a_known_point_and_scales_distances() -> None:
    target_from_source = Sim3(scale=2.0, rotation=QUARTER_TURN_ABOUT_Z, translation=np.array([10.0, 0, 0]))
    np.testing.assert_allclose(target_from_source.act([[1.0, 2.0, 3.0], [0, 0, 0]]), [[6, 2, 6], [10, 0, 0]])
    rigid = Rigid3(rotation=QUARTER_TURN_ABOUT_Z, translation=np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(Sim3.from_rigid3(rigid).matrix(), rigid.matrix())


@pytest.mark.parametrize(
    "rotation",
    [
        np.diag([1.0, 1.0, -1.0]),  # a reflection
        1.01 * np.eye(3),  # scaled
        np.full((3, 3), np.nan),
        np.eye(4),
        np.eye(3) + 1e-5 * np.ones((3, 3)),
    ],
)
def test_rigid_refuses_what_is_no_rotation(rotation: np.ndarray) -> None:
    with pytest.raises(InvalidValueError, match=r"Rigid3\.rotation"):
        Rigid3(rotation=rotation, translation=np.zeros(3))
    with pytest.raises(InvalidValueError, match=r"Rigid3\.rotation"):
        Sim3(scale=1.0, rotation=rotation, translation=np.zeros(3))


@pytest.mark.parametrize("translation", [[1.0, 2.0], [1.0, 2.0, np.inf], ["a", "b", "c"], [[1.0, 2.0, 3.0]]])
def test_rigid_refuses_bad_translations(translation: list[object]) -> None:
    with pytest.raises(InvalidValueError, match=r"Rigid3\.translation"):
        Rigid3(rotation=np.eye(3), translation=translation)  # type: ignore[arg-type]


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_sim_refuses_bad_scales(scale: float) -> None:
    with pytest.raises(InvalidValueError, match=r"Sim3\.scale"):
        Sim3(scale=scale, rotation=np.eye(3), translation=np.zeros(3))


def test_matrix_round_trip_and_refusals() -> None:
    rigid = Rigid3.exp([0.1, 0.2, 0.3, 4, 5, 6])
    for matrix in (rigid.matrix(), rigid.matrix()[:3]):
        np.testing.assert_array_equal(Rigid3.from_matrix(matrix).matrix(), rigid.matrix())
    transposed = rigid.matrix().T
    for bad in (np.eye(3), np.zeros(16), transposed):
        with pytest.raises(InvalidValueError, match="from_matrix"):
            Rigid3.from_matrix(bad)


@pytest.mark.parametrize("xyzw", [[0, 0, 0, 0], [1, 0, 0], [np.nan, 0, 0, 1], ["x", 0, 0, 1]])
def test_bad_quaternions_are_refused(xyzw: list[object]) -> None:
    with pytest.raises(InvalidValueError, match="quaternion"):
        matrix_from_quaternion(xyzw)  # type: ignore[arg-type]


def test_nearest_rotation_turns_a_reflection_into_a_rotation() -> None:
    nearest = nearest_rotation(np.diag([1.0, 1.0, -0.5]))
    np.testing.assert_allclose(nearest, np.eye(3), atol=1e-12)
    with pytest.raises(InvalidValueError):
        nearest_rotation(np.full((3, 3), np.nan))


def test_values_are_immutable_and_do_not_alias_their_source() -> None:
    rotation, translation = np.eye(3), np.zeros(3)
    rigid = Rigid3(rotation=rotation, translation=translation)
    translation[0] = 5.0
    assert rigid.translation[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        rigid.translation[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        rigid.translation = np.ones(3)  # type: ignore[misc]


def test_values_survive_pickling_for_the_process_pool() -> None:
    sim = Sim3.exp([0.1, 0.2, 0.3, 0.4, 5, 6, 7])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(sim)).matrix(), sim.matrix())


def test_frozen_array_keeps_values_or_refuses() -> None:
    assert frozen_array("a", [1, 2], (2,), np.uint8).dtype == np.uint8
    np.testing.assert_array_equal(frozen_array("a", [1.0, 2.0], (None,), np.int64), [1, 2])
    np.testing.assert_array_equal(frozen_array("a", [0, 1], (None,), np.bool_), [False, True])
    assert frozen_array("a", [], (None,), np.int32).shape == (0,)
    for value, dtype in (
        ([0.7], np.int64),
        ([300], np.uint8),
        (np.array([300]), np.uint8),
        (np.array([-1]), np.uint8),
        (np.array([2**40]), np.int32),
        ([np.nan], np.int32),
        ([2], np.bool_),
        ([1e300], np.float32),
        ([np.nan], np.float64),
        (["1"], np.float64),
        ([1 + 2j], np.float64),
        ([[1.0], [1.0, 2.0]], np.float64),
    ):
        with pytest.raises(InvalidValueError, match=r"^a: expected"):
            frozen_array("a", value, (1,), dtype)  # type: ignore[arg-type]
    assert issubclass(InvalidValueError, FeatureDbError)
