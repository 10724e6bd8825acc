"""Group laws of Rigid3 and Sim3, against SciPy's matrix functions and numerical derivatives."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import (
    matrix_from_quaternion,
    nearest_rotation,
    quaternion_from_matrix,
    rotation_angle,
    rotation_to_up,
    skew,
    so3_exp,
    so3_log,
)
from featuredb.geometry.sim3 import Sim3, point_jacobian

Transform = Rigid3 | Sim3
settings.register_profile("laws", deadline=None, max_examples=60, derandomize=True)
LAWS = settings.get_profile("laws")


def vectors(limit: float) -> st.SearchStrategy[FloatArray]:
    number = st.floats(-limit, limit, allow_subnormal=False)
    return st.tuples(number, number, number).map(lambda v: np.array(v, dtype=np.float64))


@st.composite
def rotation_vectors(draw: st.DrawFn, longest: float = np.pi - 1e-3) -> FloatArray:
    """Axis-angle vectors of all magnitudes, tiny ones as likely as large ones."""
    axis = draw(vectors(1.0).filter(lambda v: bool(np.linalg.norm(v) > 0.1)))
    angle = draw(
        st.one_of(st.just(0.0), st.floats(-12.0, np.log10(longest)).map(lambda e: min(10.0**e, longest)))
    )
    return np.asarray(angle * axis / np.linalg.norm(axis), dtype=np.float64)


@st.composite
def sigmas(draw: st.DrawFn) -> float:
    """Logarithms of scale of all magnitudes up to a factor of 50."""
    sign = draw(st.sampled_from([-1.0, 0.0, 1.0]))
    return sign * 10.0 ** draw(st.floats(-13.0, 0.6))


@st.composite
def rigid_tangents(draw: st.DrawFn) -> FloatArray:
    return np.concatenate([draw(rotation_vectors()), draw(vectors(100.0))])


@st.composite
def sim_tangents(draw: st.DrawFn) -> FloatArray:
    return np.concatenate([[draw(sigmas())], draw(rotation_vectors()), draw(vectors(100.0))])


rigids = rigid_tangents().map(Rigid3.exp)
sims = sim_tangents().map(Sim3.exp)
pairs = st.one_of(st.tuples(rigids, rigids), st.tuples(sims, sims))


def generator(tangent: FloatArray) -> FloatArray:
    """The (4, 4) element of the Lie algebra of a tangent (6,) or (7,)."""
    sigma, omega, nu = (0.0, tangent[:3], tangent[3:]) if len(tangent) == 6 else _split7(tangent)
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = sigma * np.eye(3) + skew(omega)
    matrix[:3, 3] = nu
    return matrix


def _split7(tangent: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    return float(tangent[0]), tangent[1:4], tangent[4:]


@LAWS
@given(st.one_of(rigid_tangents(), sim_tangents()))
def test_exp_is_the_matrix_exponential(tangent: FloatArray) -> None:
    transform: Transform = Rigid3.exp(tangent) if len(tangent) == 6 else Sim3.exp(tangent)
    expected = expm(generator(tangent))
    np.testing.assert_allclose(transform.matrix(), expected, rtol=1e-12, atol=1e-13 * np.abs(expected).max())


@LAWS
@given(st.one_of(rigids, sims))
def test_log_is_the_matrix_logarithm(transform: Transform) -> None:
    expected = np.real(logm(transform.matrix()))
    # SciPy's logm loses half the digits where eigenvalues nearly coincide; ours is held tighter below.
    np.testing.assert_allclose(generator(transform.log()), expected, atol=1e-5)


@LAWS
@given(st.one_of(rigid_tangents(), sim_tangents()))
def test_log_inverts_exp(tangent: FloatArray) -> None:
    transform: Transform = Rigid3.exp(tangent) if len(tangent) == 6 else Sim3.exp(tangent)
    np.testing.assert_allclose(transform.log(), tangent, rtol=1e-10, atol=1e-10)


@LAWS
@given(pairs, vectors(100.0))
def test_composition_is_the_product_of_matrices_and_acts_in_turn(
    pair: tuple[Transform, Transform], point: FloatArray
) -> None:
    outer, inner = pair
    composed: Transform = outer @ inner  # type: ignore[operator]
    np.testing.assert_allclose(composed.matrix(), outer.matrix() @ inner.matrix(), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(composed.act(point), outer.act(inner.act(point)), rtol=1e-12, atol=1e-8)


@LAWS
@given(st.one_of(rigids, sims), vectors(100.0))
def test_inverse_undoes_on_both_sides(transform: Transform, point: FloatArray) -> None:
    inverse = transform.inverse()
    for identity in (transform @ inverse, inverse @ transform):  # type: ignore[operator]
        np.testing.assert_allclose(identity.matrix(), np.eye(4), atol=1e-8)
    np.testing.assert_allclose(inverse.matrix(), np.linalg.inv(transform.matrix()), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(inverse.act(transform.act(point)), point, atol=1e-8)


@LAWS
@given(pairs.flatmap(lambda p: st.tuples(st.just(p), rigids if isinstance(p[0], Rigid3) else sims)))
def test_composition_is_associative(case: tuple[tuple[Transform, Transform], Transform]) -> None:
    (a, b), c = case
    left = ((a @ b) @ c).matrix()  # type: ignore[operator]
    right = (a @ (b @ c)).matrix()  # type: ignore[operator]
    np.testing.assert_allclose(left, right, rtol=1e-10, atol=1e-10 * np.abs(left).max())


@LAWS
@given(sims, sim_tangents())
def test_adjoint_moves_a_tangent_across(transform: Sim3, tangent: FloatArray) -> None:
    # T G(xi) T^-1 = G(Ad xi), exactly, for matrices of the algebra.
    moved = transform.matrix() @ generator(tangent) @ np.linalg.inv(transform.matrix())
    expected = generator(transform.adjoint() @ tangent)
    np.testing.assert_allclose(moved, expected, atol=1e-9 * max(1.0, np.abs(expected).max()))


def numerical_jacobian(function: Callable[[FloatArray], FloatArray], size: int) -> FloatArray:
    """Central differences of a function at zero; columns are its arguments."""
    step = 1e-5
    columns = [(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(size)]
    return np.stack(columns, axis=1)


def random_covariance(rng: np.random.Generator, size: int) -> FloatArray:
    root = rng.normal(size=(size, size))
    return np.asarray(root @ root.T, dtype=np.float64)


def example(rng: np.random.Generator) -> Sim3:
    return Sim3.exp(np.concatenate([[0.5 * rng.normal()], rng.normal(size=3), 5.0 * rng.normal(size=3)]))


@pytest.mark.parametrize("seed", range(5))
def test_covariance_of_product_against_numerical_jacobian(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    outer, inner = example(rng), example(rng)
    size = len(outer.log())
    product = outer @ inner

    def error_of_product(xi: FloatArray) -> FloatArray:
        perturbed = (Sim3.exp(xi[:size]) @ outer) @ (Sim3.exp(xi[size:]) @ inner)
        return np.asarray((perturbed @ product.inverse()).log(), dtype=np.float64)

    jacobian = numerical_jacobian(error_of_product, 2 * size)
    first, second = random_covariance(rng, size), random_covariance(rng, size)
    both = np.block([[first, np.zeros((size, size))], [np.zeros((size, size)), second]])
    expected = jacobian @ both @ jacobian.T
    np.testing.assert_allclose(first + outer.carried(second), expected, atol=1e-7 * np.abs(expected).max())


@LAWS
@given(vectors(50.0))
def test_point_jacobian_against_numerical_derivative(point: FloatArray) -> None:
    expected = numerical_jacobian(lambda xi: Sim3.exp(xi).act(point), 7)
    np.testing.assert_allclose(point_jacobian(point), expected, atol=1e-6)


def test_point_jacobian_of_many_points_is_that_of_each() -> None:
    points = np.random.default_rng(0).normal(size=(4, 2, 3))
    stacked = point_jacobian(points)
    assert stacked.shape == (4, 2, 3, 7)
    np.testing.assert_array_equal(stacked[2, 1], point_jacobian(points[2, 1]))


@LAWS
@given(sims, rigids, vectors(20.0))
def test_similarity_of_world_and_camera_leaves_the_picture_unchanged(
    target_from_source: Sim3, cam_from_source: Rigid3, offset: FloatArray
) -> None:
    # A point 5..45 in front of the camera, wherever that is.
    in_camera = np.array([offset[0], offset[1], 25.0 + offset[2]])
    source = cam_from_source.inverse().act(in_camera)
    cam_from_target = target_from_source.act_on_pose(cam_from_source)
    seen = cam_from_target.act(target_from_source.act(source))
    # The same ray; the depth is in the target's unit.
    np.testing.assert_allclose(seen / seen[2], in_camera / in_camera[2], atol=1e-6)
    assert seen[2] == pytest.approx(target_from_source.scale * in_camera[2], rel=1e-6)
    np.testing.assert_allclose(
        cam_from_target.center, target_from_source.act(cam_from_source.center), rtol=1e-9, atol=1e-7
    )


@LAWS
@given(rotation_vectors(longest=np.pi))
def test_quaternions_follow_hamilton(omega: FloatArray) -> None:
    rotation = so3_exp(omega)
    x, y, z, w = quaternion_from_matrix(rotation)
    assert w >= 0
    assert np.linalg.norm([x, y, z, w]) == pytest.approx(1.0, abs=1e-12)
    # v' = v + 2 q x (q x v + w v), the textbook form for Hamilton's quaternions.
    for v in np.eye(3):
        q = np.array([x, y, z])
        expected = v + 2 * np.cross(q, np.cross(q, v) + w * v)
        np.testing.assert_allclose(rotation @ v, expected, atol=1e-12)
    np.testing.assert_allclose(matrix_from_quaternion([3 * x, 3 * y, 3 * z, 3 * w]), rotation, atol=1e-12)


@LAWS
@given(rotation_vectors(), st.integers(0, 1000))
def test_nearest_rotation_recovers_and_minimises(omega: FloatArray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = so3_exp(omega)
    np.testing.assert_allclose(nearest_rotation(2.0 * rotation), rotation, atol=1e-12)
    noisy = rotation + 0.05 * rng.normal(size=(3, 3))
    best = nearest_rotation(noisy)
    assert np.linalg.det(best) == pytest.approx(1.0)
    distance = np.linalg.norm(noisy - best)
    for _ in range(20):
        other = so3_exp(0.02 * rng.normal(size=3)) @ best
        assert np.linalg.norm(noisy - other) >= distance - 1e-12


@LAWS
@given(rotation_vectors())
def test_a_rotation_to_up_carries_the_vector_to_z(omega: FloatArray) -> None:
    up = so3_exp(omega) @ [0.0, 0.0, 1.0]
    rotation = rotation_to_up(up)
    np.testing.assert_allclose(rotation @ up, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0.0


def test_skew_is_the_cross_product_of_many_as_of_one() -> None:
    v, w = np.random.default_rng(0).normal(size=(2, 5, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", skew(v), w), np.cross(v, w), atol=1e-12)
    np.testing.assert_array_equal(skew(v)[2], skew(v[2]))
    assert skew(np.zeros((0, 3))).shape == (0, 3, 3)


@given(rotation_vectors(np.pi), st.floats(0.01, 100.0))
def test_rotations_are_those_of_scipy(omega: FloatArray, length: float) -> None:
    theirs = Rotation.from_rotvec(omega)
    matrix = theirs.as_matrix()
    np.testing.assert_allclose(so3_exp(omega), matrix, rtol=0, atol=2e-15)
    np.testing.assert_allclose(quaternion_from_matrix(matrix), theirs.as_quat(canonical=True), atol=2e-15)
    np.testing.assert_allclose(so3_log(matrix), Rotation.from_matrix(matrix).as_rotvec(), atol=5e-15)
    np.testing.assert_allclose(matrix_from_quaternion(length * theirs.as_quat()), matrix, rtol=0, atol=2e-15)
    assert rotation_angle(matrix) == pytest.approx(theirs.magnitude(), abs=5e-15)


@pytest.mark.parametrize(
    "axis", [*np.eye(3), *-np.eye(3), [0.6, 0.0, -0.8], [-0.6, 0.8, 0.0], [0.0, -0.6, 0.8]]
)
def test_half_turns_are_those_of_scipy(axis: FloatArray) -> None:
    theirs = Rotation.from_quat([*axis, 0.0])
    found = quaternion_from_matrix(theirs.as_matrix())
    np.testing.assert_allclose(found, theirs.as_quat(canonical=True), atol=1e-15)
    assert rotation_angle(theirs.as_matrix()) == pytest.approx(np.pi, abs=1e-15)


def test_a_matrix_that_is_almost_a_rotation_counts_as_the_nearest() -> None:
    matrix = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix() + 1e-7 * np.arange(9.0).reshape(3, 3)
    np.testing.assert_allclose(so3_log(matrix), so3_log(nearest_rotation(matrix)), atol=1e-15)
    with pytest.raises(InvalidValueError, match="expected a rotation matrix"):
        quaternion_from_matrix(np.diag([1.0, 1.0, -1.0]))
