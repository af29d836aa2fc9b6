# SPDX-License-Identifier: Apache-2.0
"""Covariance of the joint filter in either of two forms. Pure functions; besides it only
``prediction``, ``running_update``, ``floor`` and ``state`` depend on the form.

Dense: ``JointState.covariance`` is that of the whole error vector, (D, D). A tick costs O(N^3).

Star: the chasers are independent of each other given the target. ``JointState.covariance`` is that
of the target (and its shape), (H, H), and ``JointState.given_target`` holds for each chaser the
regression of its error on the target's, and the covariance of the rest. A tick costs O(N).
Measurements concern one chaser and the target, and preserve this structure. Process noise of the
target does not: ``ChasersGivenTarget.after`` bounds what it leaves between two chasers, so that the
star is never more certain than all correlations allow (docs/estimation.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from msgspec.structs import replace

from .star import ChasersGivenTarget, pair
from .state import CHASER, POSE, TARGET, JointState, block


def between(s: JointState, chaser: int, rows: IntArray, columns: IntArray) -> Array:
    """Return the covariance of components ``rows`` and ``columns`` of a pair, without shape."""
    if s.given_target is None:
        at = block(chaser).start - TARGET
        i, j = (np.where(k < TARGET, k, k + at) for k in (rows, columns))
        return s.covariance[i[:, None], j]
    return pair(s.covariance, *s.given_target.of(chaser))[rows[:, None], columns]


def within(s: JointState, chasers: Sequence[int], components: IntArray) -> Array:
    """Return the covariances (n, k, k) of ``components`` of the pairs of chasers."""
    ids = np.array(chasers, dtype=np.int64)
    if s.given_target is None:
        at = CHASER * ids[:, None] * (components >= TARGET) + components
        return s.covariance[at[:, :, None], at[:, None, :]]
    hub, own = components[components < TARGET], components[components >= TARGET] - TARGET
    k, n = len(hub), len(ids)
    gains = s.given_target.gains[ids[:, None], own]
    cross = gains @ s.covariance
    out = np.empty((n, len(components), len(components)))
    out[:, :k, :k] = s.covariance[hub[:, None], hub]
    out[:, k:, :k] = cross[:, :, hub]
    out[:, :k, k:] = cross[:, :, hub].transpose(0, 2, 1)
    rest = s.given_target.covariances[ids[:, None, None], own[:, None], own]
    out[:, k:, k:] = rest + cross @ gains.transpose(0, 2, 1)
    return out


def of_chaser(s: JointState, chaser: int) -> Array:
    """Return the covariance (CHASER, CHASER) of a chaser's error."""
    if s.given_target is None:
        return s.covariance[block(chaser), block(chaser)]
    gain, rest = s.given_target.of(chaser)
    return rest + gain @ s.covariance @ gain.T


def with_target_noise(s: JointState, components: IntArray, variances: Array) -> JointState:
    """Return the state with ``variances`` added to ``components`` of the target's error."""
    wider = s.covariance.copy()
    wider[components, components] += variances
    if s.given_target is None:
        return replace(s, covariance=wider)
    given = s.given_target.after(s.covariance, np.eye(len(wider)), wider - s.covariance, wider)
    return replace(s, covariance=wider, given_target=given)


def with_chaser_noise(
    s: JointState, chaser: int, components: IntArray, variances: Array
) -> JointState:
    """Return the state with ``variances`` added to ``components`` of a chaser's error."""
    if s.given_target is None:
        wider, k = s.covariance.copy(), block(chaser).start + components
        wider[k, k] += variances
        return replace(s, covariance=wider)
    rest = s.given_target.covariances.copy()
    rest[chaser, components, components] += variances
    return replace(s, given_target=replace(s.given_target, covariances=rest))


def with_started_chaser(s: JointState, chaser: int, own: Array) -> JointState:
    """Return the state with a chaser of covariance ``own`` that is independent of all others."""
    if s.given_target is None:
        covariance = s.covariance.copy()
        covariance[block(chaser), :] = covariance[:, block(chaser)] = 0.0
        covariance[block(chaser), block(chaser)] = own
        return replace(s, covariance=covariance)
    gains, rest = s.given_target.gains.copy(), s.given_target.covariances.copy()
    gains[chaser], rest[chaser] = 0.0, own
    return replace(s, given_target=ChasersGivenTarget(gains, rest))


def with_started_target(s: JointState, chaser: int, by_chaser: Array, own: Array) -> JointState:
    """Return the state with a target of covariance ``own`` (12, 12) whose pose is known by a
    measurement of ``chaser``.

    by_chaser (6, CHASER): negative of the derivatives of the pose's error by the chaser's.
    """
    if s.given_target is None:
        covariance = s.covariance.copy()
        covariance[:TARGET, :] = covariance[:, :TARGET] = 0.0
        cross = -by_chaser @ s.covariance[block(chaser), :]
        cross[:, :TARGET] = 0.0
        covariance[POSE, :], covariance[:, POSE] = cross, cross.T
        covariance[:TARGET, :TARGET] = own
        return replace(s, covariance=covariance)
    cross, marginal = s.given_target.covariances_by(s.covariance)
    hub = s.covariance.copy()
    hub[:TARGET, :] = hub[:, :TARGET] = 0.0
    hub[:TARGET, :TARGET] = own
    with_shape = -by_chaser @ cross[chaser][:, TARGET:]
    hub[POSE, TARGET:], hub[TARGET:, POSE] = with_shape, with_shape.T
    with_others = s.given_target.gains @ cross[chaser].T
    with_others[chaser] = marginal[chaser]
    cross[:, :, :TARGET] = 0.0
    cross[:, :, POSE] = -with_others @ by_chaser.T
    given = ChasersGivenTarget.of_covariances(hub, cross, marginal)
    return replace(s, covariance=hub, given_target=given)
