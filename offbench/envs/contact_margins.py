"""Contact margins by the rule of MuJoCo before 3.5 (`max`) or since (`sum`), on every MuJoCo version.

A contact's margin and gap come from those of its two geoms:

          contact margin     contact force where     MuJoCo
    max   max(m1, m2)        dist < margin - gap     before 3.5
    sum   m1 + m2            dist < margin - gap     3.5 to 3.8
    sum   m1 + m2            dist < margin           from 3.9 on (a contact is made where dist < margin + gap)

For `max` on newer versions, geoms that all have the margin m, as in Gymnasium's Hopper and Ant, get m / 2. Margins
that differ are replaced by values h with h1 + h2 = max(m1, m2) for every pair of geoms that can collide, if such
values exist. For `sum` on older versions, they are replaced by values h with max(h1, h2) = m1 + m2. Newer
versions have this rule themselves.

One difference remains: since 4.0, the RK4 integrator rotates free and ball joints with fourth-order accuracy, before
with second. No model option restores that. Of the shipped environments it affects only Ant.
"""

from __future__ import annotations

import functools
import multiprocessing
from collections.abc import Callable

import gymnasium as gym
import mujoco
import numpy as np

from offbench.common.arrays import Array
from offbench.common.terminal import warn
from offbench.envs.margin_rule import MAX_RULE, MUJOCO_VERSIONS, SUM_RULE

SUMMED_SINCE, GAP_OUTSIDE_SINCE, RK4_ROTATIONS_SINCE = (3, 5), (3, 9), (4, 0)
ROUNDING = 1e-12  # rounding error of a sum of two margins, in the model's unit of length


def release(version: str) -> tuple[int, int]:
    """Return (major, minor) of a MuJoCo version. Raises ValueError if it is none."""
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def set_contacts(model: mujoco.MjModel, rule: str, name: str) -> None:
    """Set the contact margins of a newly loaded model by a rule, `max` or `sum`; warn if no margins reproduce it.

    Args:
        name: the model's name in a warning.
    """
    here = release(mujoco.__version__)
    if rule == (SUM_RULE if here >= SUMMED_SINCE else MAX_RULE):
        return
    combine: Callable[[Array, Array], Array]
    if rule == MAX_RULE:
        combine, solve, gaps_inside = np.maximum, _summands, -1 if here >= GAP_OUTSIDE_SINCE else 0
    else:
        combine, solve, gaps_inside = np.add, _upper_bounds, 1
    model.pair_margin += gaps_inside * model.pair_gap
    if not has_margins(model):
        return
    first, second = _colliding(model)
    gaps = combine(model.geom_gap[first], model.geom_gap[second])
    margins = combine(model.geom_margin[first], model.geom_margin[second]) + gaps_inside * gaps
    solved = [solve(first, second, wanted, model.ngeom) for wanted in (margins, gaps)]
    if solved[0] is None or solved[1] is None:
        _warn_once(name, rule)
        return
    model.geom_margin[:], model.geom_gap[:] = solved


def has_margins(model: mujoco.MjModel) -> bool:
    """Return whether the rule makes a difference for a model."""
    return bool(model.geom_margin.any() or model.geom_gap.any())


@functools.cache
def _warn_once(name: str, rule: str) -> None:
    if multiprocessing.parent_process() is None:  # a worker's parent has made the same environment
        remedy = "mujoco<3.5" if rule == MAX_RULE else "mujoco>=3.5"
        warn(
            f"{name}: no contact margins on MuJoCo {mujoco.__version__} give the contacts of "
            f"versions {MUJOCO_VERSIONS[rule]}, so the model keeps its own; for those, install '{remedy}'"
        )


def rotations_changed(model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo 4.0 and later simulate a model differently: RK4 with a free or ball joint."""
    rotating = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    return bool(model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and np.isin(model.jnt_type, rotating).any())


def model_of(env: gym.Env[Array, Array]) -> mujoco.MjModel | None:
    """Return the model of a Gymnasium MuJoCo environment; None for any other environment."""
    model = getattr(env.unwrapped, "model", None)
    return model if isinstance(model, mujoco.MjModel) else None


def _colliding(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Return the pairs of geoms, two arrays [P], that MuJoCo may test for contact.

    It tests geoms whose types match, not those of one body or of bodies welded together, of parent and child (but for
    children of the world), or of bodies that <exclude> names.
    """
    first, second = np.triu_indices(model.ngeom, 1)
    types, affinities = model.geom_contype, model.geom_conaffinity
    match = (types[first] & affinities[second]) | (types[second] & affinities[first])
    bodies = np.sort([model.geom_bodyid[first], model.geom_bodyid[second]], axis=0)
    one, other = model.body_weldid[bodies]
    parents = model.body_weldid[model.body_parentid[model.body_weldid]]
    related = (one != 0) & (other != 0) & ((one == parents[other]) | (other == parents[one]))
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        related[:] = False
    excluded = np.isin((bodies[0] << 16) + bodies[1], model.exclude_signature)
    may = (match != 0) & (one != other) & ~related & ~excluded
    return first[may], second[may]


def _summands(first: Array, second: Array, wanted: Array, geoms: int) -> Array | None:
    """Return values [geoms] that add up to `wanted` [P] for each pair of geoms; None if there are none."""
    if (wanted == wanted[:1]).all():  # the usual case, without rounding
        return np.full(geoms, wanted[0] / 2 if len(wanted) else 0.0)
    sums, totals = np.zeros((geoms, geoms)), np.zeros(geoms)  # normal equations: there are many more pairs than geoms
    for one, other in ((first, second), (second, first)):
        np.add.at(sums, (one, one), 1.0)
        np.add.at(sums, (one, other), 1.0)
        np.add.at(totals, one, wanted)
    values = np.linalg.lstsq(sums, totals, rcond=None)[0]
    return values if np.abs(values[first] + values[second] - wanted).max() <= ROUNDING else None


def _upper_bounds(first: Array, second: Array, wanted: Array, geoms: int) -> Array | None:
    """Return values [geoms] the larger of which is `wanted` [P] for each pair of geoms; None if there are none."""
    values = np.full(geoms, np.inf)  # no value may lie above what any of its pairs wants; the largest such values do
    for one in (first, second):
        np.minimum.at(values, one, wanted)
    values[np.isinf(values)] = 0.0
    largest = np.maximum(values[first], values[second])
    return values if np.abs(largest - wanted).max(initial=0.0) <= ROUNDING else None
