"""The plan of the kitchen's demonstrator: the phases in which the hand completes each subtask.

All poses are angles of the arm's seven joints, in rad.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

OPEN, CLOSED = 0.04, 0.0  # m, position of each finger
HOME = (0.148, -1.768, 1.844, -2.477, 0.26, 0.713, 1.595)  # the pose from which tries are repeated
ASIDE = (0.14, -1.63, -0.35, -2.78, -0.39, 1.17, 0.01)  # right of an open hinge door
# The phase at which the second, fourth, .. try of each subtask starts; grasps continue from the hand's
# current pose.
RETRY = (0, 0, 0, 2, 2)

# Single phases are written with numbers and tuples; in the table of all phases every field is an array.
Number = Any
Vector = Any


class Phase(NamedTuple):
    """One movement of the hand.

    The target of the tip is a point fixed to the object: the place where ``point`` would be if the object's
    joint were ``lead`` further than it is (but within ``joint_range``). To this, ``offset`` is added along
    the right, forward and upward directions of the hand. Lengths are in m, angles in rad; an object's joint
    is in rad, the slide cabinet's in m.
    """

    point: Vector = (0.0, 0.0, 0.0)
    offset: Vector = (0.0, 0.0, 0.0)
    lead: Number = 0.0
    joint_range: Vector = (-9.0, 9.0)
    yaw: Number = 0.0
    """Angle of the hand about the vertical; 0 faces the cabinets."""
    yaw_rate: Number = 0.0
    """Additional yaw per joint position of the object."""
    pitch: Number = 0.0
    """Downward angle of the hand."""
    grip: Number = CLOSED
    """Position of each finger."""
    tolerance: Number = 0.0
    """Distance at which the phase ends, m (rad for joint moves); 0 takes all steps."""
    turn_tolerance: Number = 9.0
    """Angle to the target's orientation at which the phase may end."""
    steps: Number = 20
    """Largest number of steps of the phase."""
    stop: Number = 9.0
    """Joint position of the object at which the phase ends, measured in the direction of motion."""
    lost: Number = 9.0
    """Distance from ``point`` beyond which the hand has lost the object."""
    speed: Number = 0.06
    """Largest distance of a step, m."""
    turning: Number = 0.3
    """Weight of rotation against translation, m / rad."""
    joint_move: Number = False
    """Whether to move in joint space, to ``pose``."""
    pose: Vector = HOME


def _move_to(pose: tuple[float, ...], grip: float, tolerance: float, steps: int) -> Phase:
    return Phase(pose=pose, grip=grip, tolerance=tolerance, steps=steps, joint_move=True)


def _burner() -> list[Phase]:
    """Push the upper end of the bar from left to right."""
    beside, end = (-0.052, 0.014, 0.038), (0.0, 0.0616, 0.038)
    hand = Phase(yaw=-0.4, joint_range=(0.0, 0.0))
    pose = (-0.945, -1.5, 1.4, -2.21, 0.08, 1.19, 1.31)
    return [
        _move_to(pose, CLOSED, 0.15, 30),
        hand._replace(point=beside, offset=(0, 0.004, 0), tolerance=0.02, turn_tolerance=0.35),
        hand._replace(
            point=end,
            offset=(0, 0.004, 0),
            lead=-0.947,
            joint_range=(-9, 9),
            stop=-0.68,
            steps=40,
            speed=0.1,
            turning=0.25,
        ),
        hand._replace(point=beside, offset=(0, -0.13, 0), tolerance=0.05, steps=10),
    ]


def _light() -> list[Phase]:
    """Push the switch from right to left."""
    hand = Phase(point=(0.0315, -0.075, 0.0), joint_range=(0.0, 0.0))
    pose = (-0.85, -1.23, 1.26, -2.6, -0.05, 1.93, 1.16)
    return [
        _move_to(pose, CLOSED, 0.15, 30),
        hand._replace(offset=(0.075, 0.015, 0), tolerance=0.02, turn_tolerance=0.35),
        hand._replace(offset=(-0.16, 0.02, 0), tolerance=0.02, steps=35, stop=-0.55),
        hand._replace(offset=(-0.05, -0.12, 0), tolerance=0.05, steps=12),
    ]


def _slide() -> list[Phase]:
    """Straddle the handle and drag it to the right."""
    hand = Phase(point=(-0.183, -0.123, 0.0), yaw=0.35)
    pose = (0.65, -0.81, -0.4, -2.27, -0.3, 1.5, 0.01)
    return [
        _move_to(ASIDE, OPEN, 0.4, 40),
        _move_to(pose, OPEN, 0.15, 40),
        hand._replace(offset=(0, 0.005, 0), grip=OPEN, tolerance=0.02, turn_tolerance=0.35),
        hand._replace(lead=0.08, joint_range=(0, 0.42), speed=0.08, steps=45, stop=0.2),
        hand._replace(grip=OPEN, steps=3),
        hand._replace(offset=(0, -0.13, 0), grip=OPEN, tolerance=0.04, steps=12),
        _move_to(ASIDE, OPEN, 0.5, 20),
    ]


def _hinge() -> list[Phase]:
    """Grasp the handle of the right door and walk it around its hinge."""
    hand = Phase(point=(-0.302, -0.128, 0.0), yaw_rate=0.35, grip=OPEN)
    pulling = hand._replace(turning=0.12)
    pose = (-0.99, -0.88, 1.24, -1.37, -0.1, 0.93, 0.9)
    return [
        _move_to(pose, OPEN, 0.15, 30),
        hand._replace(tolerance=0.015, turn_tolerance=0.35, steps=25),
        hand._replace(grip=CLOSED, steps=6),
        pulling._replace(
            lead=0.16, joint_range=(0, 1.5), grip=CLOSED, stop=1.22, steps=90, speed=0.05, lost=0.05
        ),
        pulling._replace(steps=5),
        pulling._replace(offset=(0, -0.14, 0), tolerance=0.04, steps=14),
    ]


def _microwave() -> list[Phase]:
    """Grasp the handle from above, since the arm cannot reach it horizontally, and pull."""
    hand = Phase(point=(0.475, -0.108, 0.05), yaw=0.3, yaw_rate=0.6, pitch=0.6, grip=OPEN)
    pulling = hand._replace(offset=(0, 0.01, 0), turning=0.15)
    pose = (-1.02, -1.29, 2.13, -1.99, 0.13, 1.63, 1.34)
    return [
        _move_to(pose, OPEN, 0.15, 30),
        hand._replace(offset=(0, 0.01, 0), tolerance=0.012, turn_tolerance=0.35, steps=25),
        hand._replace(offset=(0, 0.01, 0), grip=CLOSED, steps=7),
        pulling._replace(
            lead=-0.13,
            joint_range=(-0.95, 0),
            grip=CLOSED,
            stop=-0.62,
            steps=60,
            speed=0.05,
            lost=0.05,
        ),
        pulling._replace(steps=5),
        pulling._replace(offset=(0, -0.14, 0), tolerance=0.04, steps=14),
    ]


class Plan(NamedTuple):
    """The phases of all subtasks; the fields have shape ``[5, P]``, vectors one more axis."""

    phases: Phase
    num_phases: Int[np.ndarray, "S"]
    """The number of phases of each subtask, at most P."""


@cache
def make_plan() -> Plan:
    """The phases of all subtasks in one table. Phase 0 leads to ``HOME``; first tries begin at phase 1."""
    hub = _move_to(HOME, OPEN, 0.45, 20)
    lists = [[hub, *phases()] for phases in (_burner, _light, _slide, _hinge, _microwave)]
    longest = max(map(len, lists))
    padded = [phases + [hub] * (longest - len(phases)) for phases in lists]
    columns = {
        name: np.array([[getattr(phase, name) for phase in phases] for phases in padded])
        for name in Phase._fields
    }
    return Plan(
        phases=Phase(**{name: _single(column) for name, column in columns.items()}),
        num_phases=np.array([len(phases) for phases in lists], np.int32),
    )


def _single(column: np.ndarray) -> np.ndarray:
    return column.astype(np.float32) if column.dtype == np.float64 else column
