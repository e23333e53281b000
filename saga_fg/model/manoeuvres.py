r"""Motion of vehicles that turn and stop: along circles, along known courses, and mixtures of several.

The coordinated turn. The state has a Cartesian velocity, so that what acts on positions and velocities (interactions,
detections, range rates) finds it as in every other state, and nothing is singular at speed 0, as a course would be.
Position p and velocity v turn by the angle theta = c dt within the interval dt, at the turn rate c, rad/s, with
J = ((0, -1), (1, 0)):

    v' = R(theta) v,   p' = p + dt S(theta) v,   c' = c,   S(theta) = sin(theta) / theta I + (1 - cos(theta)) / theta J

which solves dp/dt = v, dv/dt = c J v exactly. Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation (2001), section 11.7.1. S and its derivative are smooth at theta = 0, where the motion is that
of constant velocity.

Noise: white acceleration and a random walk of c, discretised along the linear part dp/dt = v. It does not depend on the
state (Bar-Shalom, section 11.7.1): what the noise of c does to the velocity within the same interval is left out.

Curvilinear motion along known courses: a vehicle's heading and turn rate are inputs of an interval.

Of a vehicle with heading h, u = (cos h, sin h), position, velocity and acceleration move along u by the generator A_1,
and across u by A_2, in which an acceleration fades at once (`Curvilinear`). Its velocity turns by an angle theta:

    F0 = exp(A_1 dt) (x) u u^T + exp(A_2 dt) (x) (I - u u^T)
    theta = c tau (1 - exp(-dt / tau))                        c: turn rate at the start, tau: its time constant
    x0 = x with  a <- a - brake u                             brake: u . a of a vehicle that would else reverse, or 0
    (F0 x0)_v += r dt u,   (F0 x0)_p += r dt^2 / 2 u          r: acceleration to the speed of earlier traffic, or 0
    v' = R(theta) (F0 x0)_v,   a' = R(theta) (F0 x0)_a
    p' = p + sin(theta / 2) / (theta / 2) R(theta / 2) ((F0 x0)_p - p)

Wheels roll along the course: of a vehicle that nobody detects, what of the velocity is across it may fade at a rate k.
With n the normal of h + theta, and n_m that of h + theta / 2:

    v', a'  times  I - n n^T (1 - exp(-k dt))
    p' - p  times  I - n_m n_m^T (1 - (1 - exp(-k dt)) / (k dt))
    q  is raised by  2 k s^2                    from which the velocity across has the variance s^2 at last

The chord is exact for a constant speed and a constant rate; where the rate fades or the speed changes it is near.

    Q = Q_1 (x) u u^T + Q_2 (x) (I - u u^T),   Q_k = int exp(A_k s) Qc_k exp(A_k s)^T ds,   Qc_2: + q on the velocity
    q = 2 T |v|^2 var(c)

q is the acceleration across the course that an uncertain turn rate makes: its errors are taken for white, of a
correlation time T = `RATE_CORRELATION`. Q is not rotated within the interval.

With constant velocity and tau infinite this is the coordinated turn, whose turn rate is part
of the state and makes it nonlinear. Here it is estimated beside the joint state, and recorded with the interval as the
edges are: given the record the motion is linear. Sources: Bar-Shalom, Li and Kirubarajan, Estimation with Applications
to Tracking and Navigation (2001), section 11.7.1; Best and Norton (1997) for the noise along and across the heading;
Singer (1970) for the first-order decay.

Mixtures of motion are an interacting-multiple-model filter a node, matched in moments before nodes are coupled. A node
is stationary, goes straight or turns: in mode r it moves as x' = F_r x + c_r + q_r, q_r ~ N(0, Q_r), and changes
mode as a Markov chain in continuous time. Its Gaussian of each mode, N(m_s, P_s) with weight mu_s, predicts by mixing
(Blom and Bar-Shalom 1988; Bar-Shalom, Li and Kirubarajan 2001, section 11.6.6):

    w_sr = mu_s Pi_sr(dt),   mu_r <- sum_s w_sr,   N(m_r0, P_r0) matches the moments of sum_s w_sr N(m_s, P_s) / mu_r
    m_r <- F_r m_r0 + c_r,   P_r <- F_r P_r0 F_r^T + Q_r              nonlinear motions linearised at m_r0
    mu_r <- mu_r N(z; H m_r, H P_r H^T + R) / sum                     a measurement of the node; m_r, P_r as by Kalman

A joint Gaussian of n nodes would have modes^n of these. So the mixture of a node is replaced, before edges act, by the
one linear motion with the same means, covariances and cross-covariance of x and x':

    F = Cov(x', x) Cov(x)^-1,   b = E x' - F E x,
    Q = sum_sr w_sr ( Q_r + (F_r - F) P_s (F_r - F)^T + e_sr e_sr^T ),     e_sr = F_r m_s + c_r - F m_s - b

They are recorded with the interval (`saga_fg.model.scene_graph`). Before and after it the node's Gaussians follow the
joint state, which includes the neighbours' information, by the affine map that gives their mixture the moments of its
marginal.

A measurement is evidence of the mode as well. The joint state is therefore updated by an equivalent measurement of the
whole state of the node, which takes the moments (m, P) of its mixture before to those after, (m', P'): with P = L L^T,
and s, u the eigenvalues and vectors of L^-1 P' L^-T,

    u^T L^-1 (x - m) = y / (1 - s) + v,     v ~ N(0, s / (1 - s)),     y = u^T L^-1 (m' - m)

Where two modes have become equally likely a variance has grown, s > 1, which no measurement does: the shift L u y of
the mean and the spread (s - 1) L u u^T L^T then go into b and Q of the next interval. A node without edges is thus
predicted as by the filter of Blom and Bar-Shalom, exactly; and given what is recorded everything is Gaussian, and all
estimators agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
import scipy.linalg

from saga_fg.errors import InputError
from saga_fg.kernels.paths import course_inputs, course_motions
from saga_fg.model.discretisation import discretise, linear_motions
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.motion import ConstantAcceleration, ConstantVelocity, Curvilinear, NodeType
from saga_fg.model.scene_graph import OwnMotions, SceneGraph
from saga_fg.numerics import Columns, FloatArray, IntArray, unchecked
from saga_fg.settings import NonNegative, Positive, Settings, setting, settings_group

_SMALL_TURN = 1e-2  # rad; below, series
TURN_NOISE = 0.05  # spectral density of the random walk of the turn rate, rad^2/s^3


@dataclass(frozen=True)
class CoordinatedTurn(Settings):
    """A turn of nearly constant rate and speed."""

    acceleration_noise: NonNegative = setting(2.0, "spectral density of the acceleration, m^2/s^3; usual 0.3 to 3")

    components: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy", "turn_rate")
    generator: ClassVar[FloatArray] = np.diag([1.0, 1.0, 0.0], k=2)  # dp/dt = v
    initial_deviation: ClassVar[FloatArray] = np.array([1.0, 1.0, 1.0, 1.0, 0.2])  # where nothing is measured

    @property
    def diffusion(self) -> FloatArray:
        return np.diag([0.0, 0.0, self.acceleration_noise, self.acceleration_noise, TURN_NOISE])

    def flow(self, x: FloatArray, dt: float) -> FloatArray:
        """States (..., 5) after dt seconds; dt may be negative."""
        theta = x[..., 4] * dt
        along, across, _, _ = _arcs(theta)
        moved = x.copy()
        moved[..., :2] += dt * _rotated(x[..., 2:4], along, across)
        moved[..., 2:4] = _rotated(x[..., 2:4], np.cos(theta), np.sin(theta))
        return moved

    def flow_jacobian(self, x: FloatArray, dt: float) -> FloatArray:
        """Derivative (..., 5, 5) of `flow`."""
        theta, v = x[..., 4] * dt, x[..., 2:4]
        along, across, by_along, by_across = _arcs(theta)
        c, s = np.cos(theta), np.sin(theta)
        J = np.zeros((*x.shape, 5))
        J[...] = np.eye(5)
        for rows, a, b in ((slice(0, 2), dt * along, dt * across), (slice(2, 4), c, s)):
            J[..., rows, 2:4] = _rotated(np.eye(2), a[..., None], b[..., None]).swapaxes(-1, -2)
        J[..., :2, 4] = dt * dt * _rotated(v, by_along, by_across)
        J[..., 2:4, 4] = dt * _rotated(v, -s, c)
        return J


def _arcs(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """sin(theta)/theta and (1 - cos(theta))/theta, and their derivatives, smooth at 0."""
    small = np.abs(theta) < _SMALL_TURN
    t, t2 = np.where(small, 1.0, theta), theta * theta
    along = np.where(small, 1 - t2 / 6 + t2 * t2 / 120, np.sin(t) / t)
    across = np.where(small, theta / 2 - theta * t2 / 24 + theta * t2 * t2 / 720, 2 * np.sin(t / 2) ** 2 / t)
    by_along = np.where(small, -theta / 3 + theta * t2 / 30 - theta * t2 * t2 / 840, (np.cos(t) - along) / t)
    by_across = np.where(small, 0.5 - t2 / 8 + t2 * t2 / 144, (np.sin(t) - across) / t)
    return along, across, by_along, by_across


def _rotated(v: FloatArray, c: FloatArray, s: FloatArray) -> FloatArray:
    """(c I + s J) v."""
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)


RATE_CORRELATION = 1.0  # s
_MIN_TIME = 1e-3  # s, so that a fading time of 0 divides nothing by 0: the rate is gone at once
_MIN_RATE = 1e-9  # 1/s, so that nothing is divided by 0


class Unseen(NamedTuple):
    """Motion of n hidden nodes: settling and pull (n,) as in `KnownCourses`, variance across (n,) of the lateral
    velocity, (m/s)^2."""

    settling: FloatArray
    across: FloatArray
    pull: FloatArray


@dataclass(frozen=True, eq=False)
class KnownCourses(Columns):
    """n nodes of one `Curvilinear` type: ids (n,), heading (n,) rad.

    rate           (n,) turn rate, rad/s, left is positive
    lateral_noise  (n,) q above, m^2/s^3
    brake          (n, 2) mean acceleration that is taken away, m/s^2
    settling       (n,) k above, 1/s, 0 for velocities across that stay
    pull           (n,) r above, m/s^2
    """

    ids: IntArray
    heading: FloatArray
    rate: FloatArray
    lateral_noise: FloatArray
    brake: FloatArray
    settling: FloatArray
    pull: FloatArray
    node_type: NodeType

    @classmethod
    def from_turn_rates(
        cls,
        node_type: NodeType,
        ids: IntArray,
        heading: FloatArray,
        rate: FloatArray,
        rate_variance: FloatArray,
        mean: FloatArray,
        dt: float,
        unseen: Unseen | None = None,
    ) -> KnownCourses:
        """The courses over the next `dt` s of nodes with states `mean` (n, 6); rate_variance (n,) rad^2/s^2."""
        settling, across, pull = unseen or Unseen(*np.zeros((3, len(ids))))
        noise, brake = course_inputs(heading, rate_variance, mean, settling, across, dt, RATE_CORRELATION)
        return cls(
            ids=ids,
            heading=heading,
            rate=rate,
            lateral_noise=noise,
            brake=brake,
            settling=settling,
            pull=pull,
            node_type=node_type,
        )

    def predicted(self, dt: float, scale: FloatArray) -> tuple[KnownCourses, OwnMotions]:
        """dt seconds later, and the motions until then; scale (n,) of the process noise."""
        motion = self.node_type.motion
        assert isinstance(motion, Curvilinear)
        tau = max(motion.turn_time, _MIN_TIME)
        theta = self.rate * turning_time(motion, dt)
        F_axis, Q_axis = _one_axis(motion, dt)
        F, b, Q = course_motions(
            heading=self.heading,
            theta=theta,
            lateral_noise=self.lateral_noise,
            brake=self.brake,
            settling=self.settling,
            pull=self.pull,
            scale=scale,
            dt=dt,
            least=_MIN_RATE,
            F_axis=F_axis,
            Q_axis=Q_axis,
        )
        changed = {"heading": self.heading + theta, "rate": self.rate * np.exp(-dt / tau)}
        later = unchecked(KnownCourses, **self.__dict__ | changed | {"brake": np.zeros_like(self.brake)})
        return later, OwnMotions(F, b, Q)


@lru_cache(maxsize=64)  # many sensors have one interval, again and again
def _one_axis(motion: Curvilinear, dt: float) -> tuple[FloatArray, FloatArray]:
    """F and Q (3, 3, 3) along the heading, across it, and across it of white acceleration of density 1."""
    (A_1, Qc_1), (A_2, Qc_2) = motion.along, motion.across
    white = np.diag([0.0, 1.0, 0.0])
    return linear_motions(np.stack([A_1, A_2, A_2]), np.stack([Qc_1, Qc_2, white]), dt)


def turning_time(motion: Curvilinear, dt: float) -> float:
    """The time, s, in which an undiminished rate turns as far as one that fades does within `dt`."""
    tau = max(motion.turn_time, _MIN_TIME)
    return float(tau * -np.expm1(-dt / tau))


_UNUSED_DEVIATION = 0.3  # standard deviation of a component, in its unit, while its mode does not use it
_TINY = 1e-12  # probability of a mode, and share of a variance that a measurement takes away
STOP_TIME = 0.1  # time constant with which the velocity fades, s


@dataclass(frozen=True)
class Stationary(Settings):
    """Motion of an object at rest: its position drifts, its velocity decays."""

    drift: NonNegative = setting(
        0.2,
        "standard deviation of the drift of the position in one second, m; usual 0.05 to 0.5; higher: slow "
        "objects fit it, too",
    )
    speed: Positive = setting(
        0.1,
        "standard deviation of a component of the velocity, m/s; usual 0.05 to 0.3; higher: slow objects fit it, too",
    )

    components: ClassVar[tuple[str, ...]] = POSITION + VELOCITY
    generator: ClassVar[FloatArray] = np.diag([0.0, 0.0, -1.0, -1.0]) / STOP_TIME

    @property
    def diffusion(self) -> FloatArray:
        return np.diag([self.drift**2] * 2 + [2 * self.speed**2 / STOP_TIME] * 2)


@dataclass(frozen=True)
class Mixture(Settings):
    """A motion that changes between several."""

    motions: tuple[Stationary | ConstantVelocity | ConstantAcceleration | CoordinatedTurn, ...] = settings_group(
        lambda: (Stationary(), ConstantVelocity(), CoordinatedTurn()),
        "motion models of the modes; all have a velocity",
    )
    dwell_time: Positive = setting(
        5.0, "mean time in a mode before a change to another one, s; usual 2 to 10; higher: rarer changes"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.motions) < 2:
            raise InputError(f"motions: expected at least two modes, got {len(self.motions)}")

    @property
    def components(self) -> tuple[str, ...]:
        """The components of all modes, position and velocity first."""
        return tuple(dict.fromkeys(POSITION + VELOCITY + tuple(c for m in self.motions for c in m.components)))

    @property
    def generator(self) -> FloatArray:
        """The generator of constant velocity, along which edges act and late measurements are predicted."""
        return np.diag([1.0, 1.0] + [0.0] * (len(self.components) - 4), k=2)

    @property
    def diffusion(self) -> FloatArray:
        """The mean diffusion of the modes."""
        total = np.zeros((len(self.components), len(self.components)))
        for motion in self.motions:
            at = [self.components.index(c) for c in motion.components]
            total[np.ix_(at, at)] += motion.diffusion / len(self.motions)
        return total

    @property
    def initial_deviation(self) -> FloatArray:
        return np.array([1.0] * 4 + [_UNUSED_DEVIATION] * (len(self.components) - 4))

    def transition(self, dt: float) -> FloatArray:
        """Pi (M, M): probabilities of the modes (columns) dt seconds after those of the rows."""
        M = len(self.motions)
        generator = (np.ones((M, M)) / (M - 1) - np.eye(M) * M / (M - 1)) / self.dwell_time
        return np.asarray(scipy.linalg.expm(generator * dt))


class ModeDynamics(NamedTuple):
    """Dynamics of n nodes and M modes: F (n, M, d, d), c (n, M, d), Q (n, M, d, d)."""

    F: FloatArray
    c: FloatArray
    Q: FloatArray


@dataclass(frozen=True, eq=False)
class ModeTable(Columns):
    """The modes of n nodes that move by one mixture: ids (n,), weight (n, M), mean (n, M, d), P (n, M, d, d).

    shift (n, d), spread (n, d, d): by how much mean and covariance of the mixtures are ahead of those in a joint state
    """

    ids: IntArray
    weight: FloatArray
    mean: FloatArray
    P: FloatArray
    shift: FloatArray
    spread: FloatArray
    mixture: Mixture

    @staticmethod
    def new(mixture: Mixture, ids: IntArray, mean: FloatArray, P: FloatArray) -> ModeTable:
        """Nodes of which every mode is as likely: mean (n, d), P (n, d, d)."""
        n, M = len(ids), len(mixture.motions)
        tiled = np.repeat(mean[:, None], M, axis=1), np.repeat(P[:, None], M, axis=1)
        return ModeTable(ids, np.full((n, M), 1 / M), *tiled, np.zeros_like(mean), np.zeros_like(P), mixture)

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (n, d) and covariance (n, d, d) of the mixtures."""
        return _mixture_moments(self.weight, self.mean, self.P)

    def anchored(self, mean: FloatArray, P: FloatArray) -> ModeTable:
        """Mapped so that the mixtures follow the marginals (n, d) and (n, d, d) of a joint state."""
        old_mean, old_P = self.moments
        mean, L, old = mean + self.shift, np.linalg.cholesky(P + self.spread), np.linalg.cholesky(old_P)
        T = np.swapaxes(np.linalg.solve(np.swapaxes(old, 1, 2), np.swapaxes(L, 1, 2)), 1, 2)[:, None]
        moved = mean[:, None] + (T @ (self.mean - old_mean[:, None])[..., None])[..., 0]
        return replace(self, mean=moved, P=T @ self.P @ np.swapaxes(T, -1, -2))

    def predicted(self, dt: float, scale: FloatArray | None = None) -> tuple[ModeTable, OwnMotions]:
        """dt seconds later, and the linear motions with the same moments; scale (n,) of the process noise."""
        w = self.weight[:, :, None] * self.mixture.transition(dt)
        weight = w.sum(axis=1)
        mixed = [_mixture_moments(w[:, :, r] / weight[:, r, None], self.mean, self.P) for r in range(weight.shape[1])]
        start, P0 = (np.stack(parts, axis=1) for parts in zip(*mixed, strict=True))
        F, c, Q = mode_dynamics(self.mixture, start, dt)
        Q = Q if scale is None else Q * scale[:, None, None, None]
        mean = (F @ start[..., None])[..., 0] + c
        P = F @ P0 @ np.swapaxes(F, -1, -2) + Q
        level = np.zeros_like(self.shift), np.zeros_like(self.spread)
        later = ModeTable(self.ids, weight, mean, P, *level, self.mixture)
        own = self._matched(w, weight, ModeDynamics(F, c, Q))
        ahead = own.F @ self.spread @ np.swapaxes(own.F, 1, 2)
        return later, OwnMotions(own.F, own.b + (own.F @ self.shift[..., None])[..., 0], own.Q + ahead)

    def updated(
        self, ids: IntArray, z: FloatArray, H: FloatArray, R: FloatArray
    ) -> tuple[ModeTable, FloatArray, FloatArray]:
        """With a measurement each of distinct nodes: z (k, m), H (k, m, d), R (k, m, m).

        Returns z (k, d) and H (k, d, d) of the equivalent measurements for a joint state, whose R is the identity; rows
        of zeros carry no information.
        """
        rows = np.array([self._row[i] for i in ids.tolist()], dtype=np.int64)
        H, P, m = H[:, None], self.P[rows], self.mean[rows]
        gain_T = np.linalg.solve(S := H @ P @ np.swapaxes(H, -1, -2) + R[:, None], H @ P)
        innovation = z[:, None] - (H @ m[..., None])[..., 0]
        distance = (innovation * np.linalg.solve(S, innovation[..., None])[..., 0]).sum(axis=-1)
        log_weight = np.log(self.weight[rows]) - (distance + np.linalg.slogdet(S)[1]) / 2
        weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        weight = np.maximum(weight / weight.sum(axis=1, keepdims=True), _TINY)
        weight = weight / weight.sum(axis=1, keepdims=True)
        m = m + (np.swapaxes(gain_T, -1, -2) @ innovation[..., None])[..., 0]
        P = P - np.swapaxes(gain_T, -1, -2) @ S @ gain_T
        before, after = (self.moments[0][rows], self.moments[1][rows]), _mixture_moments(weight, m, P)
        equivalent, directions, shift, spread = _equivalent(*before, *after)
        later = self.copied()
        changed = {"weight": weight, "mean": m, "P": P}
        changed |= {"shift": self.shift[rows] + shift, "spread": self.spread[rows] + spread}
        for name, values in changed.items():
            vars(later)[name][rows] = values
        return later, equivalent, directions

    @cached_property
    def _row(self) -> dict[int, int]:
        return {node: row for row, node in enumerate(self.ids.tolist())}

    def _matched(self, w: FloatArray, weight: FloatArray, modes: ModeDynamics) -> OwnMotions:
        """The linear regression of x' on x over all pairs of modes; w (n, s, r)."""
        mean, P = self.moments
        near = (weight[:, :, None, None] * modes.F).sum(axis=1)  # F differs from it by what modes and states share
        apart, dF = self.mean - mean[:, None], modes.F - near[:, None]
        step = np.einsum("nrij,nsj->nsri", dF, self.mean) + modes.c[:, None]  # of x' - near x, given s and r
        shift = np.einsum("nsr,nsri->ni", w, step)
        P_of = np.einsum("nsr,nsij->nrij", w, self.P)
        cross = (dF @ P_of).sum(axis=1) + np.einsum("nsri,nsk->nik", w[..., None] * step, apart)
        F = near + np.swapaxes(np.linalg.solve(P, np.swapaxes(cross, 1, 2)), 1, 2)
        b = shift - ((F - near) @ mean[..., None])[..., 0]
        dF = modes.F - F[:, None]
        e = np.einsum("nrij,nsj->nsri", dF, self.mean) + (modes.c - b[:, None])[:, None]
        Q = np.einsum("nr,nrij->nij", weight, modes.Q)
        Q = Q + (dF @ P_of @ np.swapaxes(dF, 2, 3)).sum(axis=1) + np.einsum("nsri,nsrj->nij", w[..., None] * e, e)
        return OwnMotions(F, b, (Q + np.swapaxes(Q, 1, 2)) / 2)


def mode_dynamics(mixture: Mixture, mean: FloatArray, dt: float) -> ModeDynamics:
    """Every mode over dt, linearised at means (n, M, d); components that a mode does not have are reset to 0."""
    n, M, d = mean.shape
    F, c, Q = np.zeros((n, M, d, d)), np.zeros((n, M, d)), np.zeros((n, M, d, d))
    for r, motion in enumerate(mixture.motions):
        node_type = _node_type(motion)
        at = np.array([mixture.components.index(name) for name in node_type.components])
        rest = np.setdiff1d(np.arange(d), at)
        alone = discretise(SceneGraph.of([0], node_type), dt)
        F[:, r, at[:, None], at], Q[:, r, at[:, None], at] = alone.F[0].values[0], alone.Q[0].values[0]
        Q[:, r, rest, rest] = _UNUSED_DEVIATION**2
        if node_type.flow is not None:
            x = mean[:, r, at]
            J = node_type.flow.flow_jacobian(x, dt)
            F[:, r, at[:, None], at] = J
            c[:, r, at] = node_type.flow.flow(x, dt) - (J @ x[..., None])[..., 0]
    return ModeDynamics(F, c, Q)


@cache
def _node_type(motion: Stationary | ConstantVelocity | ConstantAcceleration | CoordinatedTurn) -> NodeType:
    return NodeType(type(motion).__name__, motion)


def _equivalent(
    mean: FloatArray, P: FloatArray, later: FloatArray, later_P: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """z (k, d) and H (k, d, d) of the measurement that takes N(mean, P) to N(later, later_P); shift and spread."""
    L = np.linalg.cholesky(P)
    W = np.linalg.inv(L)
    share, U = np.linalg.eigh(W @ later_P @ np.swapaxes(W, 1, 2))
    directions, axes = np.swapaxes(U, 1, 2) @ W, L @ U
    y = (directions @ (later - mean)[..., None])[..., 0]
    informative = share < 1 - _TINY
    rest = np.where(informative, 1 - share, 1.0)
    scale = np.where(informative, np.sqrt(rest / np.where(informative, share, 1.0)), 0.0)
    z = scale * (y / rest + (directions @ mean[..., None])[..., 0])
    left = np.where(informative, 0.0, y), np.where(informative, 0.0, np.maximum(share - 1, 0.0))
    spread = (axes * left[1][:, None]) @ np.swapaxes(axes, 1, 2)
    return z, scale[..., None] * directions, (axes @ left[0][..., None])[..., 0], spread


def _mixture_moments(weight: FloatArray, mean: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (n, d) and covariance (n, d, d) of mixtures: weight (n, M), mean (n, M, d), P (n, M, d, d)."""
    middle = np.einsum("ns,nsi->ni", weight, mean)
    apart = mean - middle[:, None]
    return middle, np.einsum("ns,nsij->nij", weight, P) + np.einsum("ns,nsi,nsj->nij", weight, apart, apart)
