"""Contact margins as MuJoCo before 3.5 had them, on every MuJoCo version.

A contact's margin and gap come from those of its two geoms. `sum` and `max` name how:

          contact margin     contact force where     MuJoCo
    max   max(m1, m2)        dist < margin - gap     before 3.5
    sum   m1 + m2            dist < margin - gap     3.5 to 3.8
    sum   m1 + m2            dist < margin           from 3.9 on (a contact is made where dist < margin + gap)

On newer versions, geoms that all have the margin m, as in Gymnasium's Hopper and Ant, therefore get m / 2. Margins
that differ are replaced by values h with h1 + h2 = max(m1, m2) for every pair of geoms that can collide, if such
values exist.

Not undone: since 4.0, the RK4 integrator rotates free and ball joints with fourth-order accuracy, before with second.
No model option restores that. Of the shipped environments it affects only Ant.
"""

from __future__ import annotations

import functools
import multiprocessing
import sys
from typing import Any

import mujoco
import numpy as np

from offbench.policy import Array

SUMMED_SINCE, GAP_OUTSIDE_SINCE, RK4_ROTATIONS_SINCE = (3, 5), (3, 9), (4, 0)
ROUNDING = 1e-12  # of a sum of two margins, in the model's unit of length


def release(version: str) -> tuple[int, int]:
    """Return (major, minor) of a MuJoCo version. Raises ValueError if it is none."""
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def restore_margins(model: mujoco.MjModel, name: str) -> None:
    """Give a freshly loaded model the contacts that MuJoCo before 3.5 would give it; leave it alone if that fails.

    Args:
        name: what a warning calls the model.
    """
    here = release(mujoco.__version__)
    if here < SUMMED_SINCE:
        return
    margins, gaps = model.geom_margin.copy(), model.geom_gap.copy()
    if here >= GAP_OUTSIDE_SINCE:
        model.pair_margin -= model.pair_gap
    if not (margins.any() or gaps.any()):
        return
    if (margins == margins[0]).all() and (gaps == gaps[0]).all():
        inside = gaps if here >= GAP_OUTSIDE_SINCE else 0.0
        model.geom_margin[:], model.geom_gap[:] = (margins - inside) / 2, gaps / 2
        return
    first, second = _colliding(model)
    margin, gap = np.maximum(margins[first], margins[second]), np.maximum(gaps[first], gaps[second])
    if here >= GAP_OUTSIDE_SINCE:
        margin = margin - gap
    shares = [_shares(first, second, wanted, model.ngeom) for wanted in (margin, gap)]
    if shares[0] is None or shares[1] is None:
        _warn_once(name)
        return
    model.geom_margin[:], model.geom_gap[:] = shares


@functools.cache
def _warn_once(name: str) -> None:
    if multiprocessing.parent_process() is None:  # a worker's parent has made the same environment
        print(
            f"offbench: warning: {name}: MuJoCo {mujoco.__version__} adds the contact margins of two geoms, versions "
            "before 3.5 took the larger; no margins restore its earlier contacts; for those, install 'mujoco<3.5'",
            file=sys.stderr,
        )


def rotations_changed(model: mujoco.MjModel) -> bool:
    """Return whether a model moves differently since MuJoCo 4.0: RK4 with a free or ball joint."""
    turning = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    return bool(model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and np.isin(model.jnt_type, turning).any())


def model_of(env: Any) -> mujoco.MjModel | None:
    """Return the model of a Gymnasium MuJoCo environment; None for any other environment."""
    model = getattr(env.unwrapped, "model", None)
    return model if isinstance(model, mujoco.MjModel) else None


def _colliding(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Return the pairs of geoms, two arrays [P], that MuJoCo may test for contact: of two bodies, types that match."""
    first, second = np.triu_indices(model.ngeom, 1)
    body, types, affinities = model.geom_bodyid, model.geom_contype, model.geom_conaffinity
    match = (types[first] & affinities[second]) | (types[second] & affinities[first])
    may = (match != 0) & (body[first] != body[second])
    return first[may], second[may]


def _shares(first: Array, second: Array, wanted: Array, geoms: int) -> Array | None:
    """Return values [geoms] that add up to `wanted` [P] for each pair of geoms; None if there are none."""
    sums, totals = np.zeros((geoms, geoms)), np.zeros(geoms)  # normal equations: there are many more pairs than geoms
    for one, other in ((first, second), (second, first)):
        np.add.at(sums, (one, one), 1.0)
        np.add.at(sums, (one, other), 1.0)
        np.add.at(totals, one, wanted)
    values = np.linalg.lstsq(sums, totals, rcond=None)[0]
    return values if np.abs(values[first] + values[second] - wanted).max(initial=0.0) <= ROUNDING else None
