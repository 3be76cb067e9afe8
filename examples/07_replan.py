"""Half-way up, a part is late and a robot breaks down: plan on from here, and say what changes.

Run: python examples/07_replan.py
"""

from __future__ import annotations

from falsework import Action, Direction, Replanner, check, find_plans, load_structure
from falsework.replanning import difference


def main() -> None:
    """A dome that three robots build."""
    dome = load_structure("dome:rings=3,blocks=6")
    old = find_plans(dome, robots=3).unwrap()
    replanner = Replanner(dome)  # hand in policy=falsework.load_policy("my-run") once you have trained one

    # Some steps are done when word comes that the next part to go in is late.
    next_one = next(step for step in old[len(old) // 3 :] if step.action is Action.INSERT)
    state, late = old.states[next_one.number - 1], next_one.part
    answer = replanner.replan(state, missing=[late], robots=3)
    new = answer.unwrap()
    print(f"{dome.names[late]} is late; {answer.decided_by.value} has another plan after {answer.seconds:.2f} s:")
    print(f"  {difference(old, new).text}")
    for need in new.needs:
        print(f"  {dome.names[need.part]} is needed after {need.after_parts} other parts")

    # The next morning a robot is down as well, and answers are wanted within half a second.
    few = next(step for step in range(4, len(new)) if (new.states[step][~dome.boundary] == 2).sum() <= 2)
    answer = replanner.replan(new.states[few], direction=Direction.ASSEMBLY, robots=2, alternatives=3, deadline=0.5)
    if not answer.found:
        print(f"with two robots: {answer.outcome.value}, {answer.reason}")
    for plan in answer.plans:
        print(f"with two robots: {len(plan)} steps, first {plan[0]}, then {plan[1]}")
        assert check(dome, plan).good


if __name__ == "__main__":
    main()
