"""A part comes late, another must not be touched: plan again, and choose among plans that differ.

Run: python examples/05_change_of_plan.py
"""

from __future__ import annotations

import falsework as fw


def main() -> None:
    """A dome whose key and one more block have not been delivered."""
    dome = fw.load_structure("dome:rings=2,blocks=6")
    late = [part for part in range(dome.part_count) if not dome.boundary[part]][-2:]

    planning = fw.find_plans(dome, robots=2, missing=late, settings=fw.PlannerSettings(alternatives=3))
    for need in planning.unwrap().needs:
        print(f"{dome.names[need.part]} is needed after {need.after_parts} other parts are placed")

    print(f"{len(planning.plans)} plans; share by which each two differ:")
    for row in planning.alternatives.distance:
        print("  ", " ".join(f"{value:.2f}" for value in row))
    for plan in planning.plans:
        assert fw.check(dome, plan).good


if __name__ == "__main__":
    main()
