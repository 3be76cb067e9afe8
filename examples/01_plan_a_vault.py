"""Plan a thin vault with two robots, print the plan in order of assembly, and let the exact solver check it.

Run: python examples/01_plan_a_vault.py
"""

from __future__ import annotations

import falsework as fw


def main() -> None:
    """From a structure to a plan on disk."""
    vault = fw.load_structure("vault")
    print(f"{vault.name}: {vault.part_count} parts, {len(vault.contacts)} contacts")

    planning = fw.find_plans(vault, robots=2)
    print(f"found in {planning.result.seconds:.1f} s, {planning.result.counters.asked} verdicts")

    # A plan takes a structure apart; reversed, it builds it.
    plan = planning.plans[0].reverse()
    for step in range(len(plan)):
        print(f"{step + 1:4d}  {plan.describe(step)}")

    report = fw.validate_plan(plan, vault)
    print(f"{report.checked} of {report.states} states proven stable by the exact solver")
    fw.save_plan(plan, "vault-plan.json")


if __name__ == "__main__":
    main()
