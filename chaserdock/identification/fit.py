# SPDX-License-Identifier: Apache-2.0
"""Identifies a robot from a recorded run by maximum likelihood (R. Maine and K. Iliff,
"Identification of Dynamic Systems", NASA RP-1138, 1985, chapters 6 and 7).

Motion tells thrusts and inertia only in units of the mass: twice the mass with twice the thrusts
moves alike. The scale is set by the weighed mass, or else by the mean of the stated thrusts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from chaserdock_models.arrays import Array

from .motion_filter import (
    INERTIA_ROWS,
    Actuation,
    Commanded,
    MotionFilter,
    Noise,
    Pass,
    RobotParameters,
    actuation_of,
    commanded_over,
)
from .recorded import RecordedRobot, ResponseDelay, recorded_robot


@dataclass(frozen=True)
class FitParameters:
    """Widths of what is known before the run, and numbers of the iteration."""

    # Standard deviation of each gain, and of the inertia as a share of its mean moment: a quarter
    # of what a value may have to count as identified is then the run's alone to 1 in 9.
    share: float = 1.0
    # Standard deviation of a nozzle's direction, rad: a degree, as drawings and mounts allow.
    nozzle_rad: float = 0.0175
    # Standard deviations of the delay, s, of the square of the lag's time constant, s^2, and of
    # constant force, N, and torque, N m: beyond all that a robot which flies at all can have.
    delay_s: float = 0.3
    lag_s2: float = 0.01
    force_N: float = 1.0
    torque_N_m: float = 0.1
    # Delays, s, from which the best is improved: pulses last 0.1 s.
    delays_s: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3)
    # Scatter of each thruster's impulse, a share, of which the likeliest is taken.
    scatter_shares: tuple[float, ...] = (0.0, 0.01, 0.02, 0.03, 0.05, 0.1)
    # Passes at most; five suffice from 30 % off.
    passes: int = 15
    # Change in standard deviations from which the noise is taken from the residuals.
    near_sigmas: float = 3.0
    # Change in standard deviations at which passes end: a tenth of what is printed.
    settled_sigmas: float = 0.02
    # Share of the smallest moment of inertia that a step must leave.
    kept_inertia: float = 0.25
    # Noise of exact odometry, m, m/s, rad, rad/s: error of the prediction within a tick.
    floors: tuple[float, ...] = (1e-5, 1e-5, 1e-5, 1e-5)
    # Largest standard deviation of an identified value as a share of its size: three of them are
    # as large as the value itself.
    known_share: float = 1.0 / 3.0
    # Correlation of successive residuals from which something else moves the robot: five standard
    # deviations at 600 ticks of 12 components are 0.06.
    correlated: float = 0.1


_FIT = FitParameters()


@dataclass(frozen=True)
class IdentifiedQuantity:
    """One identified value in SI units. ``stated``: by the scenario. ``known``: whether the run
    tells it; if not, ``value`` has no meaning.
    """

    name: str
    unit: str
    stated: float
    value: float
    sigma: float
    known: bool

    @property
    def off_sigmas(self) -> float:
        """Difference to the stated value in standard deviations."""
        return (self.value - self.stated) / self.sigma if self.sigma > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class RobotIdentification:
    """What a run tells of a robot.

    ``values`` (Q,), ``covariance`` (Q, Q) of ``quantities``. ``noise_ratio``: measured noise of the
    odometry over the stated one, of position, velocity, attitude and rate; NaN where that is exact.
    ``correlation``: of successive residuals.
    """

    robot: RecordedRobot
    mass_kg: float
    weighed: bool
    quantities: tuple[IdentifiedQuantity, ...]
    covariance: Array
    scatter_share: float
    noise_ratio: tuple[float, ...]
    correlation: float

    def named(self, prefix: str) -> list[IdentifiedQuantity]:
        """Return the quantities whose names begin with ``prefix``."""
        return [q for q in self.quantities if q.name.startswith(prefix)]

    @property
    def disturbed(self) -> bool:
        """Whether something that the model does not have moves the robot."""
        return abs(self.correlation) > _FIT.correlated


def identify(
    source: str | Path, chaser: int = 0, mass_kg: float | None = None
) -> RobotIdentification:
    """Identify the robot of a chaser from the log of a run.

    ``mass_kg``: as weighed. Without it, thrusts are right on average, or with ideal actuators
    forces are as commanded, and the mass follows. Raises IdentificationError, LogError.
    """
    return identify_robot(recorded_robot(source, chaser), mass_kg)


def identify_robot(robot: RecordedRobot, mass_kg: float | None = None) -> RobotIdentification:
    """Identify a robot from what a log knows of it. ``mass_kg``: see ``identify``."""
    body = robot.scenario.chaser
    actuation = actuation_of(body)
    mass = body.mass_kg if mass_kg is None else mass_kg
    fit = _Fit(robot, actuation, mass)
    parameters, found, noise = fit.converged()
    values, covariance = _scaled(robot, actuation, mass, parameters, found, mass_kg is not None)
    quantities = _quantities(robot, actuation, values, covariance, mass_kg is not None)
    stated = np.diag(robot.motion.noise).reshape(4, 3).mean(axis=1)
    shown = np.diag(noise.measured).reshape(4, 3).mean(axis=1)
    ratio = np.sqrt(np.divide(shown, stated, out=np.full(4, np.nan), where=stated > 0.0))
    return RobotIdentification(
        robot,
        float(values[0]),
        mass_kg is not None,
        quantities,
        covariance,
        noise.scatter_share,
        tuple(ratio.tolist()),
        _correlation(found.innovations),
    )


class _Fit:
    """Repeats passes about their result."""

    def __init__(self, robot: RecordedRobot, actuation: Actuation, mass_kg: float) -> None:
        self._robot, self._actuation, self._mass_kg = robot, actuation, mass_kg
        body, errors = robot.scenario.chaser, robot.scenario.navigation.errors()
        moments = np.array(body.inertia)
        self._nominal = RobotParameters(
            actuation.nominal,
            np.zeros(3),
            np.array([*moments, 0.0, 0.0, 0.0]),
            np.zeros(6),
            0.0,
            0.0,
            np.zeros(3),
        )
        self._prior = _prior(actuation, body.size_m, moments, errors.gyro_bias_rad_s)
        self._lag = len(self._prior) - 4  # row of the square of the lag
        self._prior[self._lag] = _FIT.lag_s2 if robot.actuators.lags else 0.0
        own = np.diag(robot.motion.noise)
        floors = np.repeat(_FIT.floors, 3)
        wander = np.zeros(12)
        wander[:3] = 2.0 * errors.position_drift_m**2 / errors.position_drift_time_s
        wander[6:9] = 2.0 * errors.attitude_drift_rad**2 / errors.attitude_drift_time_s
        self._least = np.maximum(np.sqrt(own) * 0.1, floors)
        self._stated = robot.motion.noise + np.diag(floors**2)
        self._noise = Noise(self._stated, wander, 0.0)
        self._commanded: tuple[ResponseDelay, Commanded] | None = None

    def converged(self) -> tuple[RobotParameters, Pass, Noise]:
        """Return the likeliest parameters, the last pass, and the noise."""
        parameters, found = self._iterated(self._with_best_delay())
        while (likelier := self._with_best_scatter(parameters)) != self._noise.scatter_share:
            self._noise = replace(self._noise, scatter_share=likelier)
            parameters, found = self._iterated(parameters)
        return parameters, found, self._noise

    def _with_best_delay(self) -> RobotParameters:
        tries = [replace(self._nominal, delay_s=delay) for delay in _FIT.delays_s]
        return max(tries, key=lambda p: self._run(p, self._noise).log_likelihood)

    def _with_best_scatter(self, parameters: RobotParameters) -> float:
        """Return the likeliest scatter, not below the present one: noise that it explains now is
        not the odometry's any more.
        """
        tries = [share for share in _FIT.scatter_shares if share >= self._noise.scatter_share]
        noises = [replace(self._noise, scatter_share=share) for share in tries]
        likelihoods = [self._run(parameters, noise).log_likelihood for noise in noises]
        return tries[int(np.argmax(likelihoods))]

    def _iterated(self, parameters: RobotParameters) -> tuple[RobotParameters, Pass]:
        for _ in range(_FIT.passes):
            found = self._run(parameters, self._noise)
            before, parameters = (
                parameters.vector,
                _moved(parameters, self._possible(parameters, found)),
            )
            change = np.abs(parameters.vector - before)
            steps = change / np.maximum(_sigmas(found.covariance), 1e-300)
            if steps.max() < _FIT.near_sigmas:
                self._noise = self._noise_about(parameters)
            if steps.max() < _FIT.settled_sigmas:
                break
        return parameters, self._run(parameters, self._noise)

    def _possible(self, parameters: RobotParameters, found: Pass) -> Array:
        """Return the change (P,) of a pass, or the likeliest without a lag where its square would
        become negative.
        """
        change, k = found.change, self._lag
        short = -(parameters.lag_s2 + change[k])
        if short <= 0.0:
            return change
        return change + found.covariance[:, k] * (short / found.covariance[k, k])

    def _noise_about(self, parameters: RobotParameters) -> Noise:
        """Return the noise that the residuals about known parameters show, as stated where they do
        not.
        """
        run = MotionFilter(self._actuation, self._mass_kg, parameters, self._noise).run
        none = np.zeros(len(self._prior))
        found = run(self._robot.motion, self._commanded_by(parameters), none, none)
        shown = np.where(np.isnan(found.measured), self._stated, found.measured)
        return replace(self._noise, measured=self._positive(shown))

    def _run(self, parameters: RobotParameters, noise: Noise) -> Pass:
        start = self._nominal.vector - parameters.vector
        run = MotionFilter(self._actuation, self._mass_kg, parameters, noise).run
        return run(self._robot.motion, self._commanded_by(parameters), start, self._prior)

    def _commanded_by(self, parameters: RobotParameters) -> Commanded:
        latency = parameters.latency
        if self._commanded is None or self._commanded[0] != latency:
            time_ns = self._robot.motion.time_ns
            found = commanded_over(self._robot.actuators, time_ns, parameters)
            self._commanded = latency, found
        return self._commanded[1]

    def _positive(self, covariance: Array) -> Array:
        """Return a covariance (12, 12) whose standard deviations are not below what is credible."""
        scaled = covariance / np.outer(self._least, self._least)
        values, vectors = np.linalg.eigh((scaled + scaled.T) / 2.0)
        kept = vectors @ np.diag(np.maximum(values, 1.0)) @ vectors.T
        return kept * np.outer(self._least, self._least)


def _prior(
    actuation: Actuation, size_m: Sequence[float], moments: Array, gyro_bias_rad_s: float
) -> Array:
    """Return the standard deviations (P,) of the parameters before the run."""
    gains = np.full(actuation.gains, _FIT.nozzle_rad)
    gains[list(actuation.along)] = _FIT.share
    planar = not actuation.axes.all()
    held = np.array([1.0, 1.0, 0.0]) if planar else np.ones(3)
    inertia = np.full(6, _FIT.share * float(moments.mean()))
    if planar:
        inertia *= [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    pushes = np.repeat([_FIT.force_N, _FIT.torque_N_m], 3) * actuation.axes
    centre = held * max(size_m) / 2.0
    return np.concatenate(
        [gains, centre, inertia, pushes, [_FIT.delay_s, 0.0], np.full(3, gyro_bias_rad_s)]
    )


def _moved(parameters: RobotParameters, change: Array) -> RobotParameters:
    """Return the parameters after a step, shortened until a body can have the inertia: far from the
    solution a step goes too far.
    """
    least = np.linalg.eigvalsh(parameters.tensor)[0] * _FIT.kept_inertia
    while np.linalg.eigvalsh(RobotParameters.of(parameters.vector + change).tensor)[0] < least:
        change = change / 2.0
    return RobotParameters.of(parameters.vector + change)


def _sigmas(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def _scaled(
    robot: RecordedRobot,
    actuation: Actuation,
    mass_kg: float,
    parameters: RobotParameters,
    found: Pass,
    weighed: bool,
) -> tuple[Array, Array]:
    """Return mass, gains along the stated directions, centre, inertia, push, delay and square of
    the lag (Q,), and their covariance.

    The filter's unit of force is divided by the mean gain, unless the mass is weighed.
    """
    along, n = list(actuation.along), actuation.gains
    sigma = _sigmas(found.covariance)
    used = [
        k for k in along if len(along) == 1 or sigma[k] < _FIT.known_share * parameters.gains[k]
    ]
    size = len(parameters.vector)
    scale, by_gain = 1.0, np.zeros(size)
    if used and not weighed:
        scale = float(parameters.gains[used].mean())
        by_gain[used] = 1.0 / len(used)
    rows = [*along, *range(n, n + 17)]
    kept = np.array([*along, *range(n + 3, n + 15)])
    values = parameters.vector.copy()
    jacobian = np.eye(size)
    jacobian[kept] = (jacobian[kept] - np.outer(values[kept], by_gain) / scale) / scale
    values[kept] /= scale
    jacobian = np.concatenate([[-mass_kg / scale**2 * by_gain], jacobian[rows]])
    values = np.concatenate([[mass_kg / scale], values[rows]])
    return values, jacobian @ found.covariance @ jacobian.T


def _quantities(
    robot: RecordedRobot, actuation: Actuation, values: Array, covariance: Array, weighed: bool
) -> tuple[IdentifiedQuantity, ...]:
    body, sigma = robot.scenario.chaser, _sigmas(covariance)
    thrusters = body.thrusters if body.actuation == "thrusters" else ()
    count, axes = len(actuation.along), actuation.axes
    stated_N = np.array([t.thrust_N for t in thrusters]) if thrusters else np.ones(1)
    scales = np.concatenate([[1.0], stated_N, np.ones(17)])
    values, sigma = values * scales, sigma * scales
    moment = float(values[1 + count + 3 : 1 + count + 6].mean())
    tick_s = 1.0 / robot.scenario.time.rate_hz
    out: list[IdentifiedQuantity] = []

    def add(name: str, unit: str, row: int, stated: float, size: float) -> None:
        known = bool(0.0 < sigma[row] < _FIT.known_share * size)
        out.append(
            IdentifiedQuantity(name, unit, stated, float(values[row]), float(sigma[row]), known)
        )

    if not weighed:
        add("mass", "kg", 0, body.mass_kg, float(values[0]))
    row = 1 + count
    for k, axis in enumerate("xyz"):
        if axes[:3].all() or axis != "z":
            add(f"centre {axis}", "m", row + k, 0.0, max(body.size_m) / 2.0)
    for k, (i, j) in enumerate(INERTIA_ROWS):
        if axes.all() or (i, j) == (2, 2):
            stated = body.inertia[i] if i == j else 0.0
            size = float(values[row + 3 + k]) if i == j else moment
            add(f"I{'xyz'[i]}{'xyz'[j]}", "kg m²", row + 3 + k, stated, size)
    for k in range(count):
        if thrusters:
            add(f"thruster {k}", "N", 1 + k, float(stated_N[k]), float(values[1 + k]))
        elif weighed:
            add("force and torque, share", "", 1, 1.0, float(values[1]))
    add("delay", "s", row + 15, 0.0, tick_s)
    if robot.actuators.lags:
        square = max(0.0, float(values[row + 16]))
        lag_s = math.sqrt(square)
        longest_s = float(values[row + 15]) + float(sigma[row + 15]) / _FIT.known_share
        # More than the mean delay is no lag, but an error of the odometry that looks like one.
        known = bool(sigma[row + 16] < _FIT.known_share * square) and lag_s < longest_s
        lag_sigma_s = float(sigma[row + 16]) / (2.0 * lag_s) if known else math.inf
        out.append(IdentifiedQuantity("lag", "s", 0.0, lag_s, lag_sigma_s, known))
    for k in np.flatnonzero(axes).tolist():
        name, unit = ("force", "N") if k < 3 else ("torque", "N m")
        add(f"{name} {'xyz'[k % 3]}", unit, row + 9 + k, 0.0, math.inf)
    return tuple(out)


def _correlation(innovations: Array) -> float:
    """Return the mean correlation of successive innovations (M, 12)."""
    white = innovations / np.maximum(innovations.std(axis=0), 1e-300)
    return float((white[1:] * white[:-1]).mean())
