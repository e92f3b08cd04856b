"""What the paper reports: the cells of Tables 2–5, their numbers, and its claims about differences between them.

A cell is one experiment (table, robot motion, motion and speed of the dynamic features) run by one method (gate and
camera). The paper leaves out RE with the oscillating camera; it is added here, because only with it can the effect of
the gate be told from that of the camera. The paper's "Recovered Features" are `recovered_per_run` and its "Dynamic
Points" are `dynamic_events_per_run`: means per run of events, which is why they exceed the six dynamic features.
"""

import dataclasses
import math
from collections.abc import Collection, Iterator, Sequence
from typing import Literal

Gate = Literal["RE", "VC"]


@dataclasses.dataclass(frozen=True)
class Cell:
    """One cell of the paper's tables: an experiment and the method that ran it."""

    table: int
    """Number of the paper's table, 2 to 5."""
    robot_motion: str
    """"forward", "curved" or "lateral"."""
    dynamic_motion: str | None
    """Motion of the dynamic features, "lateral" or "inverse_forward"; None in a static scene."""
    dynamic_speed_m_s: float | None
    """Their speed, m/s; None in a static scene."""
    gate: Gate
    """"RE" or "VC"."""
    oscillating: bool
    """Whether the camera oscillates."""

    @property
    def identifier(self) -> str:
        """A name for files, e.g. `table4_forward_lateral_0.50mps_VC_oscillating`."""
        scene = "static" if self.dynamic_motion is None else f"{self.dynamic_motion}_{self.dynamic_speed_m_s:.2f}mps"
        camera = "oscillating" if self.oscillating else "steady"
        return f"table{self.table}_{self.robot_motion}_{scene}_{self.gate}_{camera}"

    @property
    def experiment(self) -> tuple[int, str, str | None, float | None]:
        """Table, robot motion, dynamic motion and speed: what cells that may be paired have in common."""
        return self.table, self.robot_motion, self.dynamic_motion, self.dynamic_speed_m_s

    @property
    def case(self) -> str:
        """What tells the experiments of one table apart: the robot's motion in Table 2, the features' in the others."""
        return self.robot_motion if self.dynamic_motion is None else self.dynamic_motion.replace("_", " ")

    @property
    def method(self) -> str:
        """Gate and camera in words, e.g. "VC, oscillating camera"."""
        return f"{self.gate}, {'oscillating' if self.oscillating else 'steady'} camera"


Method = tuple[Gate, bool]
"""Gate, and whether the camera oscillates."""

RE: Method = ("RE", False)
VC: Method = ("VC", False)
VC_OSCILLATING: Method = ("VC", True)
RE_OSCILLATING: Method = ("RE", True)
METHODS = (RE, VC, VC_OSCILLATING, RE_OSCILLATING)
"""The paper's three columns, in its order, and the one it leaves out."""

COMPARISONS = {
    "VC - RE (steady)": (VC, RE),
    "VC - RE (oscillating)": (VC_OSCILLATING, RE_OSCILLATING),
    "oscillating - steady (VC)": (VC_OSCILLATING, VC),
    "oscillating - steady (RE)": (RE_OSCILLATING, RE),
    "VC oscillating - RE steady": (VC_OSCILLATING, RE),
}
"""Differences taken within an experiment: name, minuend, subtrahend."""

TABLES = (2, 3, 4, 5)
SPEEDS_M_S = {3: 1.0, 4: 0.5, 5: 0.25}
ROBOT_MOTIONS = ("forward", "curved", "lateral")
DYNAMIC_MOTIONS = ("lateral", "inverse_forward")

# Per experiment: (position error in cm, orientation error in deg, count) for RE, VC and VC with the oscillating camera.
_NUMBERS = {
    (2, "forward"): ((5.7318, 0.1272, 0), (5.6966, 0.1208, 17), (4.2568, 0.1169, 16)),
    (2, "curved"): ((4.8793, 0.1203, 0), (4.8409, 0.1159, 16), (2.7066, 0.1130, 17)),
    (2, "lateral"): ((4.3247, 0.2435, 0), (3.9828, 0.2287, 16), (3.7290, 0.2144, 16)),
    (3, "lateral"): ((5.7167, 0.1393, 27), (5.9133, 0.1429, 28), (4.5283, 0.1284, 29)),
    (3, "inverse_forward"): ((5.8394, 0.1222, 0), (5.7285, 0.1236, 0), (9.3783, 0.1353, 24)),
    (4, "lateral"): ((6.1239, 0.1562, 3), (5.7186, 0.1413, 2), (4.6172, 0.3739, 43)),
    (4, "inverse_forward"): ((6.1498, 0.1170, 0), (5.4650, 0.1120, 0), (12.5170, 0.1251, 18)),
    (5, "lateral"): ((5.9099, 0.1729, 6), (5.8257, 0.1582, 11), (5.0702, 0.5228, 48)),
    (5, "inverse_forward"): ((5.6649, 0.1308, 0), (5.6610, 0.1190, 0), (15.1492, 0.1195, 9)),
}


def cells(tables: Collection[int] = TABLES) -> list[Cell]:
    """All cells of the given tables, experiment by experiment, each with the methods in the order of `METHODS`.

    Raises:
        ValueError: if a table is none of 2 to 5.
    """
    unknown = sorted(set(tables) - set(TABLES))
    if unknown:
        raise ValueError(f"cells(tables={tuple(tables)}): no table {unknown[0]}; choose among {TABLES}.")
    return [
        _cell(table, motion, method)
        for table in TABLES
        if table in tables
        for motion in (ROBOT_MOTIONS if table == 2 else DYNAMIC_MOTIONS)
        for method in METHODS
    ]


def paper_figures(cell: Cell) -> dict[str, float] | None:
    """The paper's numbers of a cell by the names that `summarise` gives the same figures; None where it has none."""
    method = (cell.gate, cell.oscillating)
    if method == RE_OSCILLATING:
        return None
    motion = cell.robot_motion if cell.table == 2 else cell.dynamic_motion
    position_cm, orientation_deg, count = _NUMBERS[cell.table, str(motion)][METHODS.index(method)]
    counted = "recovered_per_run" if cell.table == 2 else "dynamic_events_per_run"
    return {"position_rmse_cm": position_cm, "orientation_error_deg": orientation_deg, counted: count}


def pairs(available: Collection[Cell]) -> Iterator[tuple[str, Cell, Cell]]:
    """The comparisons that the available cells allow: (name, minuend, subtrahend), experiment by experiment."""
    for experiment in dict.fromkeys(cell.experiment for cell in cells()):
        for name, methods in COMPARISONS.items():
            minuend, subtrahend = (Cell(*experiment, *method) for method in methods)
            if minuend in available and subtrahend in available:
                yield name, minuend, subtrahend


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement of the paper: that a figure, or its difference between two cells, lies between `low` and `high`."""

    text: str
    figure: str
    minuend: Cell
    subtrahend: Cell | None
    """None where the claim is about the minuend's figure itself."""
    low: float
    high: float


Region = tuple[float, float]
LOWER: Region = (-math.inf, 0.0)
HIGHER: Region = (0.0, math.inf)
SIXTEEN_OR_SEVENTEEN: Region = (15.5, 17.5)  # rounds to one of them
NONE: Region = (-math.inf, 0.5)  # rounds to zero per run
SOME: Region = (0.5, math.inf)
SAME_COUNT: Region = (-1.5, 1.5)  # rounds to a difference of at most one, as in the paper
SIMILAR_CM: Region = (-0.5, 0.5)  # the paper's own errors differ by 0.2 cm

_Statement = tuple[str, str, Method, Method | None, Region]

_STATIC: tuple[_Statement, ...] = (
    ("VC has a lower position error than RE (steady camera)", "position_rmse_cm", VC, RE, LOWER),
    ("VC has a lower orientation error than RE (steady camera)", "orientation_error_deg", VC, RE, LOWER),
    ("oscillation lowers VC's position error", "position_rmse_cm", VC_OSCILLATING, VC, LOWER),
    ("oscillation lowers VC's orientation error", "orientation_error_deg", VC_OSCILLATING, VC, LOWER),
    ("VC oscillating has a lower position error than RE steady", "position_rmse_cm", VC_OSCILLATING, RE, LOWER),
    ("VC steady recovers features", "recovered_per_run", VC, None, SOME),
    ("VC steady recovers 16–17 features", "recovered_per_run", VC, None, SIXTEEN_OR_SEVENTEEN),
    ("VC oscillating recovers features", "recovered_per_run", VC_OSCILLATING, None, SOME),
    ("VC oscillating recovers 16–17 features", "recovered_per_run", VC_OSCILLATING, None, SIXTEEN_OR_SEVENTEEN),
    ("oscillation leaves the recovered count alone (± 1)", "recovered_per_run", VC_OSCILLATING, VC, SAME_COUNT),
)
_LATERAL: tuple[_Statement, ...] = (
    ("RE steady finds movers", "dynamic_found_per_run", RE, None, SOME),
    ("VC steady finds movers", "dynamic_found_per_run", VC, None, SOME),
    ("VC oscillating finds movers", "dynamic_found_per_run", VC_OSCILLATING, None, SOME),
    ("oscillation raises VC's dynamic events", "dynamic_events_per_run", VC_OSCILLATING, VC, HIGHER),
    ("oscillation makes VC find more movers", "dynamic_found_per_run", VC_OSCILLATING, VC, HIGHER),
    ("oscillation lowers VC's position error", "position_rmse_cm", VC_OSCILLATING, VC, LOWER),
    ("VC oscillating has a lower position error than RE steady", "position_rmse_cm", VC_OSCILLATING, RE, LOWER),
)
_LATERAL_FAST: tuple[_Statement, ...] = (
    ("RE and VC have similar position errors (steady camera, ± 0.5 cm)", "position_rmse_cm", VC, RE, SIMILAR_CM),
    ("oscillation lowers VC's orientation error", "orientation_error_deg", VC_OSCILLATING, VC, LOWER),
)
_LATERAL_SLOW: tuple[_Statement, ...] = (
    ("oscillation raises VC's orientation error", "orientation_error_deg", VC_OSCILLATING, VC, HIGHER),
)
_THAN_AT_1_M_S: tuple[_Statement, ...] = (
    ("RE steady has fewer dynamic events than at 1 m/s", "dynamic_events_per_run", RE, RE, LOWER),
    ("VC steady has fewer dynamic events than at 1 m/s", "dynamic_events_per_run", VC, VC, LOWER),
    (
        "VC oscillating has more dynamic events than at 1 m/s",
        "dynamic_events_per_run",
        VC_OSCILLATING,
        VC_OSCILLATING,
        HIGHER,
    ),
)
_INVERSE_FORWARD: tuple[_Statement, ...] = (
    ("RE steady has no dynamic event", "dynamic_events_per_run", RE, None, NONE),
    ("VC steady has no dynamic event", "dynamic_events_per_run", VC, None, NONE),
    ("RE steady finds no mover", "dynamic_found_per_run", RE, None, NONE),
    ("VC steady finds no mover", "dynamic_found_per_run", VC, None, NONE),
    ("oscillation raises VC's dynamic events", "dynamic_events_per_run", VC_OSCILLATING, VC, HIGHER),
    ("oscillation makes VC find more movers", "dynamic_found_per_run", VC_OSCILLATING, VC, HIGHER),
    ("oscillation raises VC's position error", "position_rmse_cm", VC_OSCILLATING, VC, HIGHER),
    ("VC oscillating has a higher position error than RE steady", "position_rmse_cm", VC_OSCILLATING, RE, HIGHER),
)


def claims(table: int) -> list[Claim]:
    """The paper's claims about one table, from its sections 4 and 5 and, where these are silent, its numbers."""
    if table == 2:
        return [claim for statement in _STATIC for motion in ROBOT_MOTIONS for claim in _claims([statement], 2, motion)]
    lateral = _LATERAL + (_LATERAL_FAST if table == 3 else _LATERAL_SLOW)
    slower = [] if table == 3 else _claims(_THAN_AT_1_M_S, table, "lateral", other_table=3)
    return [*_claims(lateral, table, "lateral"), *slower, *_claims(_INVERSE_FORWARD, table, "inverse_forward")]


def _claims(
    statements: Sequence[_Statement], table: int, motion: str, other_table: int | None = None
) -> Iterator[Claim]:
    for text, figure, minuend, subtrahend, (low, high) in statements:
        other = None if subtrahend is None else _cell(other_table or table, motion, subtrahend)
        yield Claim(text, figure, _cell(table, motion, minuend), other, low, high)


def _cell(table: int, motion: str, method: Method) -> Cell:
    if table == 2:
        return Cell(2, motion, None, None, *method)
    return Cell(table, "forward", motion, SPEEDS_M_S[table], *method)
