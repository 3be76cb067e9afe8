"""One robot cannot build an arch. Prove it, and count the plans that two robots have.

Run: python examples/06_no_plan.py
"""

from __future__ import annotations

from falsework import StabilityOracle, load_structure, make_task
from falsework.search import ExhaustiveSearch


def main() -> None:
    """Look at every state that can be reached by taking the arch apart."""
    arch = load_structure("arch:blocks=5")
    oracle = StabilityOracle(arch)
    for robots in (1, 2, 3):
        census = ExhaustiveSearch(make_task(arch, robots), oracle, name=arch.name).run()
        print(
            f"{robots} robots: {census.states} states, {census.solvable_states} of them not dead ends, "
            f"{census.plans} plans ({census.result.outcome})"
        )
    print("verdicts:", oracle.counters.to_dict())


if __name__ == "__main__":
    main()
