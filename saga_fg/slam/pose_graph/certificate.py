"""Proof that poses are the global minimum of the chordal cost, and the way to it where they are not.

At frames Y_i with F = tr(Y^T Q Y), and with the multipliers Lambda of the constraints Y_i Y_i^T = 1,

    S = Q - blockdiag(Lambda_1, ..., Lambda_N),     F* >= F + N d min(lambda_min(S), 0)

for frames of any dimension r, as tr(Y'^T Lambda Y') is F for all frames Y'. At a critical point S Y = 0, and it is the
global minimum if no eigenvalue of S is negative. The signs of the pivots of S + eta 1 tell whether one is below -eta;
with the positions, of which the first is fixed, S is sparse, and has as many negative pivots. The lowest eigenvalue is
then the one nearest to -eta, which shifted inverse iteration finds at once.

Where an eigenvalue is negative its vector is a direction of descent for frames of one dimension more (the Riemannian
staircase). At a global minimum of more than d dimensions the frames are rounded to rotations, which are improved in
their turn; the cost of the frames is a bound from below for theirs.

Source: Rosen, Carlone, Bandeira, Leonard, SE-Sync, IJRR 2019; Rosen, Accelerating Certifiable Estimation with
Preconditioned Eigensolvers, RA-L 2022, for the test by factorisation.

Minimum of a quadratic form over N orthonormal frames: a Riemannian trust region.

    min tr( Y^T Q Y ),     Y = ( Y_1; ...; Y_N ),  Y_i (d, r),  Y_i Y_i^T = 1

For r = d these are the rotations and reflections of d dimensions. Frames of more dimensions, r > d, are a relaxation
without bad minima where r is large enough. With G = Q Y, the tangent space at Y, and Lambda_i = sym(G_i Y_i^T),

    grad = 2 (G - Lambda Y),      Hess[V] = 2 P( Q V - Lambda V ),      P(V)_i = V_i - sym(V_i Y_i^T) Y_i

Steps come from truncated conjugate gradients with a preconditioner (Steihaug 1983, Toint 1981), and lead back to the
frames by the polar decomposition. Source: Absil, Mahony, Sepulchre, Optimization Algorithms on Matrix Manifolds
(2008), algorithms 10 and 11.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import block_diag, csc_array, diags_array
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh

from saga_fg.numerics import FloatArray
from saga_fg.slam.pose_graph.chordal import ChordalCost, factorised, nearest_rotations
from saga_fg.slam.pose_graph.graph import PoseGraph

Product = Callable[[FloatArray], FloatArray]
_ACCEPTED, _POOR, _GOOD = 0.05, 0.25, 0.9  # shares of the promised decrease: to take a step, to shrink, to grow
_STEP_ROUNDING = 1e-13  # of the cost: differences below are noise
_MIN_DECREASE = 1e-11  # of the cost: a step that promises less, and does not hold it, meets rounding
_MIN_RADIUS = 1e-12  # of steps: below, none decreases the cost
_MAX_STEPS, _MAX_INNER = 200, 300


@dataclass(eq=False)
class Frames:
    """The form at frames Y (N, d, r); products: number of those with Q on the way there."""

    Q: Product
    preconditioner: Product
    Y: FloatArray
    products: int = 0

    @cached_property
    def QY(self) -> FloatArray:
        return self._times(self.Q, self.Y)

    @cached_property
    def cost(self) -> float:
        return float((self.Y * self.QY).sum())

    @cached_property
    def gradient(self) -> FloatArray:
        return np.asarray(2 * (self.QY - self._multipliers @ self.Y))

    @cached_property
    def conditioned_gradient(self) -> FloatArray:
        return self.conditioned(self.gradient)

    @cached_property
    def slope(self) -> float:
        """Square of the gradient in the metric of the preconditioner."""
        return float((self.gradient * self.conditioned_gradient).sum())

    def hessian(self, V: FloatArray) -> FloatArray:
        return 2 * self._tangent(self._times(self.Q, V) - self._multipliers @ V)

    def conditioned(self, V: FloatArray) -> FloatArray:
        return self._tangent(self._times(self.preconditioner, V))

    @cached_property
    def _multipliers(self) -> FloatArray:
        return multipliers(self.Y, self.QY)

    def _tangent(self, V: FloatArray) -> FloatArray:
        return np.asarray(V - multipliers(self.Y, V) @ self.Y)

    def _times(self, product: Product, V: FloatArray) -> FloatArray:
        return product(V.reshape(-1, V.shape[2])).reshape(V.shape)


def multipliers(Y: FloatArray, V: FloatArray) -> FloatArray:
    """Symmetric parts (N, d, d) of V_i Y_i^T; of V = Q Y they are Lambda."""
    product = V @ Y.swapaxes(1, 2)
    return np.asarray((product + product.swapaxes(1, 2)) / 2)


def nearest_frames(V: FloatArray) -> FloatArray:
    """Orthonormal frames (N, d, r) nearest to V (N, d, r)."""
    U, _, Wt = np.linalg.svd(V, full_matrices=False)
    return np.asarray(U @ Wt)


def best_frames(
    Q: Product, preconditioner: Product, Y: FloatArray, tolerance: float, most_products: float = np.inf
) -> Frames:
    """A local minimum from a start Y (N, d, r). Q, preconditioner: products with (N d, r).

    tolerance: decrease that a step of the preconditioner still promises, relative to the cost; most_products: with Q,
    after which the way ends where it is
    """
    here = Frames(Q, preconditioner, np.ascontiguousarray(Y))
    radius = np.sqrt(Y.shape[0] * Y.shape[1]) / 8
    products = 0
    for _ in range(_MAX_STEPS):
        if here.slope <= tolerance * here.cost or radius < _MIN_RADIUS or products >= most_products:
            break
        step, promised, at_bound, count = _truncated_cg(here, radius, min(_MAX_INNER, most_products - products))
        products += count + 1
        there = Frames(Q, preconditioner, nearest_frames(Y + step))
        noise = _STEP_ROUNDING * here.cost
        ratio = (here.cost - there.cost + noise) / (promised + noise)
        if ratio < _POOR:
            radius /= 4
        elif ratio > _GOOD and at_bound:
            radius *= 2
        if ratio > _ACCEPTED:
            here, Y = there, there.Y
        elif promised <= _MIN_DECREASE * here.cost:
            break
    here.products = products
    return here


def _truncated_cg(at: Frames, radius: float, most: float) -> tuple[FloatArray, float, bool, int]:
    """The step, the decrease it promises, whether it ends at the bound of the trust region, and its iterations.

    Lengths are measured in the metric of the preconditioner, by recursion (Conn, Gould, Toint 2000, section 7.5.1).
    """
    step, H_step, residual = np.zeros_like(at.Y), np.zeros_like(at.Y), at.gradient
    direction, rz = -at.conditioned_gradient, at.slope
    enough = rz * min(0.1, np.sqrt(rz)) ** 2
    ss, sd, dd = 0.0, 0.0, rz  # squares and product of step and direction
    at_bound = False
    count = 0
    for count in range(1, 1 + math.ceil(most)):  # noqa: B007
        H = at.hessian(direction)
        curvature = float((direction * H).sum())
        alpha = rz / curvature if curvature > 0 else np.inf
        at_bound = not (ss + 2 * alpha * sd + alpha**2 * dd < radius**2)
        if at_bound:
            alpha = (-sd + np.sqrt(sd**2 + dd * (radius**2 - ss))) / dd
        step, H_step, residual = step + alpha * direction, H_step + alpha * H, residual + alpha * H
        conditioned = at.conditioned(residual)
        before, rz = rz, float((residual * conditioned).sum())
        if at_bound or rz <= enough:
            break
        beta = rz / before
        ss, sd, dd = ss + 2 * alpha * sd + alpha**2 * dd, beta * (sd + alpha * dd), rz + beta**2 * dd
        direction = -conditioned + beta * direction
    return step, -float((at.gradient * step).sum() + (step * H_step).sum() / 2), at_bound, count


GAP = 1e-6  # relative difference between the cost and its proven bound at which poses count as the global minimum
MOST_DIMENSIONS = 7  # more than d of the frames; the staircase ends far lower, where it ends at all
_ROUNDING = 1e-11  # of the largest entry of S: eigenvalues nearer to 0 can't be told from it
_CONVERGED = 1e-14  # decrease that a step still promises, relative to the cost: rounding
_NEARLY = 1e-10  # the same for frames of more dimensions: slow where some are superfluous, and the bound holds anyhow
_MAX_WORK = 5e9  # products with Q, times entries of its factors: half a minute in all, then the bound is a loose one
_SHORTEST = 1e-8  # step along an eigenvector, of a length of sqrt(N d) in all
_ACCURACY = 1e-4  # of an eigenvalue, relative to the shift
_MIN_COST = 1e-13  # cost that counts as none, relative to the trace of M: rounding, where all measurements agree
_LARGER = 10.0  # ratio of successive shifts, until no eigenvalue is below


@dataclass(frozen=True, eq=False)
class ChordalMinimum:
    """Poses of least chordal cost, and what that cost can't fall below.

    world_T_pose  (N, d + 1, d + 1), in the frame of the priors, or with the first as in the graph
    cost          F of these poses
    bound         proven lower bound of F over all poses, 0 at least
    eigenvalue    a lower bound, 0 or less, of the eigenvalues of S at the frames that prove this
    dimensions    r of these frames; d: the poses themselves
    """

    world_T_pose: FloatArray
    cost: float
    bound: float
    eigenvalue: float
    dimensions: int

    @property
    def gap(self) -> float:
        """Difference between cost and bound, relative to the cost; 0 for poses that agree with all measurements."""
        return (self.cost - self.bound) / self.cost if self.cost > 0 else 0.0

    @property
    def certified(self) -> bool:
        """True if this is the global minimum of the chordal cost."""
        return self.gap <= GAP


def chordal_minimum(graph: PoseGraph, start: FloatArray) -> ChordalMinimum:
    """The minimum of the chordal cost by the staircase; start: poses (N, d + 1, d + 1)."""
    cost, d = ChordalCost.of(graph), graph.dim
    if graph.anchored:
        start = np.concatenate([start, np.eye(d + 1)[None]])
    proofs: list[tuple[float, float, int]] = []  # bound, eigenvalue, dimensions
    most = _MAX_WORK / cost.entries

    def tested(frames: Frames) -> LowestEigenvalue:
        n, _, r = frames.Y.shape
        lowest = lowest_eigenvalue(cost, frames.Y)
        proofs.append((frames.cost + n * d * lowest.value, lowest.value, r))
        return lowest

    found = frames = descend(cost, start[:, :d, :d].swapaxes(1, 2), most / 2)
    left = 0.75 * most - found.products  # the last quarter is for the way down from the staircase
    while (lowest := tested(frames)).direction is not None and frames.Y.shape[2] < d + MOST_DIMENSIONS:
        left -= lowest.factorisations * cost.products_per_factorisation
        if left <= 0:
            break
        start = _escaped(cost, frames, lowest.direction)
        frames = best_frames(cost.times, cost.preconditioned, start, _NEARLY, left)
        left -= frames.products
    if frames is not found:
        found = min(found, descend(cost, rounded_rotations(frames.Y), most / 4), key=lambda each: each.cost)
        tested(found)
    bound, eigenvalue, dimensions = max(proofs)
    least = found.cost if found.cost > _MIN_COST * cost.M.trace() else 0.0
    return ChordalMinimum(_poses(graph, cost, found.Y), least, min(max(bound, 0.0), least), eigenvalue, dimensions)


def descend(cost: ChordalCost, Y: FloatArray, most_products: float = math.inf) -> Frames:
    """The local minimum from frames Y (N, d, r), or where the way there ends for its length."""
    return best_frames(cost.times, cost.preconditioned, Y, _CONVERGED, most_products)


@dataclass(frozen=True, eq=False)
class LowestEigenvalue:
    """value: lower bound of the eigenvalues of S, at most 0; direction (N, d): of the lowest, None if it may be 0.

    factorisations: how many it took
    """

    value: float
    direction: FloatArray | None
    factorisations: int


def lowest_eigenvalue(cost: ChordalCost, Y: FloatArray) -> LowestEigenvalue:
    """The test of S at frames Y (N, d, r)."""
    n, d, r = Y.shape
    flat = Y.reshape(n * d, r)
    QY = cost.times(flat)
    L = multipliers(Y, QY.reshape(Y.shape))
    free = np.delete(np.arange(cost.M.shape[0]), d)  # without the first position
    blocks = np.zeros((n, d + 1, d + 1))
    blocks[:, :d, :d] = L
    points = csc_array((cost.M.shape[0] - n * (d + 1),) * 2)
    S = (cost.M - block_diag([*blocks, points], format="csc")).tocsc()[free][:, free]
    on_rotations = diags_array(np.isin(free, cost.rotations).astype(np.float64)).tocsc()
    eta = max(GAP * float((flat * QY).sum()) / (n * d), _ROUNDING * float(abs(cost.M).max()))
    count = 1
    while ((solver := factorised(S + eta * on_rotations)).U.diagonal() <= 0).any():
        count, eta = count + 1, eta * _LARGER
    value, vector = _eigenpair(cost, L, solver, eta)
    return LowestEigenvalue(min(value, 0.0) - 2 * _ACCURACY * eta, vector.reshape(n, d) if count > 1 else None, count)


def _eigenpair(cost: ChordalCost, L: FloatArray, solver: SuperLU, eta: float) -> tuple[float, FloatArray]:
    """The lowest eigenvalue of S and its vector (N d,), which lies above -eta: `solver` factorises S + eta."""
    size, d = len(cost.rotations), cost.dim
    rows = cost.rotations - (cost.rotations > d)  # without the first position

    def times(v: FloatArray) -> FloatArray:
        V = v.reshape(size, 1)
        return (cost.times(V) - (L @ V.reshape(-1, d, 1)).reshape(size, 1)).ravel()

    def solve(v: FloatArray) -> FloatArray:
        whole = np.zeros(cost.M.shape[0] - 1)
        whole[rows] = v.ravel()
        return np.asarray(solver.solve(whole)[rows])

    S, inverse = (LinearOperator((size, size), matvec=f, dtype=np.float64) for f in (times, solve))
    start = np.random.default_rng(0).normal(size=size)
    value, vector = eigsh(S, k=1, sigma=-eta, which="LM", OPinv=inverse, v0=start, tol=_ACCURACY)
    return float(value[0]), vector[:, 0]


def _escaped(cost: ChordalCost, frames: Frames, direction: FloatArray) -> FloatArray:
    """Frames (N, d, r + 1) of lower cost, along an eigenvector (N, d) of S with a negative eigenvalue."""
    n, d, r = frames.Y.shape
    lifted = np.concatenate([frames.Y, np.zeros((n, d, 1))], axis=2)
    step = np.zeros_like(lifted)
    step[:, :, r] = direction
    length = np.sqrt(n * d)
    while length > _SHORTEST:
        moved = nearest_frames(lifted + length * step)
        flat = moved.reshape(n * d, r + 1)
        if float((flat * cost.times(flat)).sum()) < frames.cost:
            return moved
        length /= 2
    return lifted


def rounded_rotations(Y: FloatArray) -> FloatArray:
    """Rotations (N, d, d), transposed as frames are, near frames (N, d, r) of more dimensions."""
    n, d, r = Y.shape
    _, _, Wt = np.linalg.svd(Y.reshape(n * d, r), full_matrices=False)
    R = Y @ Wt[:d].T
    if (np.linalg.det(R) < 0).sum() > n / 2:
        R = R * np.where(np.arange(d) == d - 1, -1.0, 1.0)
    return nearest_rotations(R)


def _poses(graph: PoseGraph, cost: ChordalCost, Y: FloatArray) -> FloatArray:
    """Poses of rotations as frames (N, d, d), in the frame of the graph."""
    n, d, _ = Y.shape
    poses = np.tile(np.eye(d + 1), (n, 1, 1))
    poses[:, :d, :d] = Y.swapaxes(1, 2)
    poses[:, :d, d] = cost.best_positions(Y.reshape(n * d, d))[:n]
    return graph.in_its_frame(poses)
