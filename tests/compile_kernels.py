"""Compilation of the kernels that the tests run, in two parallel processes, before test workers start.

Portable code becomes machine code of this processor; what is not in the archive numba compiles beside the sources.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from falsework import load_structure, make_task
from falsework.assembly import complete_state
from falsework.utils.kernel_code import ARCHIVE


def _portable(group: str) -> None:
    module, _, name = next(iter(ARCHIVE.index[group]["entries"])).rpartition(".")
    assert ARCHIVE.load(module, name)


def _judge() -> None:
    from falsework.stability.judges.discrete_elements import BuildJudge

    assembly = load_structure("arch:blocks=5")
    BuildJudge(assembly).judge(complete_state(assembly.boundary)[None], [()])


def _cones() -> None:
    clearance = make_task(load_structure("shelf:shelves=0"), removable_only_if_clear=True).clearance
    assert clearance is not None
    clearance.prepare()


if __name__ == "__main__":
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_judge), *(pool.submit(_portable, group) for group in ARCHIVE.index), pool.submit(_cones)]
        for job in jobs:
            job.result()
