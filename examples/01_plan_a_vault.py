"""Plan a thin vault with two robots, print the steps, and let the exact solver check them.

Run: python examples/01_plan_a_vault.py
"""

from __future__ import annotations

import falsework as fw


def main() -> None:
    """From a structure to a plan on disk."""
    vault = fw.load_structure("vault")
    print(f"{vault.name}: {vault.part_count} parts, {len(vault.contacts)} contacts")

    planning = fw.find_plans(vault, robots=2)
    print(f"found in {planning.statistics['seconds']:.1f} s, {planning.statistics['verdicts']} verdicts")

    plan = planning.unwrap()
    for step in plan:
        print(f"{step.number:4d}  {step}")  # such as `1  insert voussoir-3 (R1)`

    report = fw.check(vault, plan)
    print(f"{report.checked} of {report.states} states proven stable by the exact solver")
    fw.save(plan, "vault-plan.json")


if __name__ == "__main__":
    main()
