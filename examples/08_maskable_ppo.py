"""Train the learner of another library, MaskablePPO of sb3-contrib, to take a small arch apart.

Run: pip install sb3-contrib, then: python examples/08_maskable_ppo.py
"""

from __future__ import annotations

from falsework import StabilityOracle, StateGraph, load_structure, make_task
from falsework.search import BeamSearch, BeamSettings


def main(steps: int = 2048) -> None:
    """Learn from the states of a search, and count from how many of them the policy gets to the end."""
    from sb3_contrib import MaskablePPO

    from falsework.learn import DisassemblyEnv

    arch = load_structure("arch:blocks=5")
    oracle = StabilityOracle(arch)
    search = BeamSearch(make_task(arch), oracle, BeamSettings(width=16))
    search.run()
    graph = StateGraph.from_states(make_task(arch), search.states())

    # Episodes begin at states of the graph: from the complete arch alone, chance hardly ever gets to the end.
    environment = DisassemblyEnv(arch, starts=graph, oracle=oracle)
    model = MaskablePPO("MlpPolicy", environment, n_steps=512, batch_size=128, learning_rate=2e-3, gamma=0.95, seed=0)

    starts = graph.states[graph.solvable & (graph.level < graph.task.steps)]

    def success() -> float:
        done = 0
        for state in starts:
            observation, info = environment.reset(options={"start": state})
            over = False
            while not over:
                action, _ = model.predict(observation, action_masks=info["action_mask"], deterministic=True)
                observation, _, over, _, info = environment.step(int(action))
            done += info["success"]
        return done / len(starts)

    print(f"before: {success():.0%} of {len(starts)} states solved")
    model.learn(steps)
    print(f"after {steps} steps: {success():.0%} of {len(starts)} states solved")


if __name__ == "__main__":
    main()
