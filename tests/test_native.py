"""The compiled kernels: the same bits from every instruction set, and one clear error where they cannot be had."""

from __future__ import annotations

import ctypes
import shutil
from pathlib import Path

import numpy as np
import pytest
from chaserdock_controller import native
from chaserdock_controller.native.build import X86_64, source_digest
from chaserdock_controller.nmpc import NmpcInput, kernels, make_solver
from nmpc_cases import PARAMS, Array, at_rest, fixed_problem, fly, swap

LEVELS = [number for number, _ in X86_64]


def has(number: int) -> bool:
    return native.level() != 0 and number <= native.level()


@pytest.mark.parametrize("number", LEVELS)
def test_every_instruction_set_gives_the_same_bits(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two chasers swapping head-on, one in a corridor: interior point, tilted planes, cone."""
    if not has(number):
        pytest.skip(f"this processor has no copy {number}")
    corridors = np.zeros((2, 31, 5))
    corridors[0, :] = [-1.0, 0.0, 0.0, 1.2, 2.0]

    def flown() -> tuple[Array, list[int]]:
        problem_at, states = swap()

        def with_corridor(x: Array, now_s: float) -> NmpcInput:
            problem = problem_at(x, now_s)
            return NmpcInput(**{**vars(problem), "corridors": corridors})

        flight = fly(make_solver("rti", PARAMS, 2), with_corridor, states, 0.1, 2.0)
        return flight.states, [int(p.iterations.sum()) for p in flight.plans]

    expected, iterations = flown()
    assert any(iterations)
    own = native.function
    monkeypatch.setattr(kernels, "function", lambda name, result=None: own(name, result, number))
    states, _ = flown()
    np.testing.assert_array_equal(states, expected)


def copied(folder: Path) -> Path:
    """The package's folder with sources and library, to be tampered with."""
    target = folder / "native"
    shutil.copytree(Path(native.__file__).parent, target, ignore=shutil.ignore_patterns("__pycache__"))
    return target / "kernels.so"


def test_a_library_of_other_sources_is_refused(tmp_path: Path) -> None:
    library = copied(tmp_path)
    assert native.load(library).source_digest().decode() == source_digest(library.parent)
    with (library.parent / "cost.c").open("a") as file:
        file.write("\n/* an edit */\n")
    with pytest.raises(ImportError, match=r"compiled from other sources.*pip install"):
        native.load.__wrapped__(library)


def test_a_library_that_is_missing_or_broken_is_named(tmp_path: Path) -> None:
    library = copied(tmp_path)
    library.write_bytes(b"not a library")
    with pytest.raises(ImportError, match=r"not for this kind of machine.*pip install"):
        native.load.__wrapped__(library)
    library.unlink()
    with pytest.raises(ImportError, match=r"missing.*pip install"):
        native.load.__wrapped__(library)


def test_the_library_asks_for_no_other() -> None:
    """Neither a C library nor any other: so one file serves every Linux of its processor."""
    content = native.LIBRARY.read_bytes()
    assert not any(name in content for name in (b"libc.so", b"libm.so", b"GLIBC_"))


def test_rows_between_chasers_far_apart_are_left_out_only_where_none_is_reached() -> None:
    """The quick test for a pair finds what the whole one finds: with a reach just above and just below the room."""
    states = np.array([at_rest(np.array([-2.0, 2.0, 0.0])), at_rest(np.array([2.0, 2.0, 0.0]))])
    problem = fixed_problem(states, states[:, :3], d_target=0.0)
    frame = make_solver("rti", PARAMS, 2)._frame  # pyright: ignore[reportAttributeAccessIssue]
    task = frame.begin(problem, 0.0, None)
    x = frame.rolled(task, task.start)
    room_m = 0.5 * (4.0 - 0.35 - 5e-3)
    for reach_m, rows in ((room_m - 1e-6, 0), (room_m + 1e-6, 30)):
        found = kernels.build_rows(task.problem, x, 25.0, np.full((2, 31), reach_m))
        assert list(found.n_rows) == [rows, rows]


def test_working_memory_is_enough() -> None:
    """Nothing is written behind the memory that a tick asks for, with as many rows as there can be."""
    n, d = 3, PARAMS.stages
    doubles = native.function("tick_workspace", ctypes.c_int64)(ctypes.c_int64(n), ctypes.c_int64(d))
    guarded = np.full(doubles + 64, 7.0)
    rng = np.random.default_rng(1)
    states = np.array([at_rest(0.3 * rng.normal(size=3)) for _ in range(n)])
    corridors = np.tile([1.0, 0, 0, 0.5, 0.0], (n, d + 1, 1))
    problem = NmpcInput(**{**vars(fixed_problem(states, -states[:, :3])), "corridors": corridors})
    kept = kernels._tick_memory
    kept.cache_clear()
    patch = pytest.MonkeyPatch()
    patch.setattr(kernels, "_tick_memory", lambda n, d: guarded)
    plan = make_solver("rti", PARAMS, n).solve(problem, 0.0)
    patch.undo()
    assert plan.iterations.all()
    assert (guarded[doubles:] == 7.0).all()
    assert (guarded[:doubles] != 7.0).mean() > 0.5
