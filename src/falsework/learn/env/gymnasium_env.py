"""Gymnasium environment for other reinforcement learning libraries; importing this module registers it.

After `import falsework.learn.env.gymnasium_env`,
`gymnasium.make("falsework/Disassembly-v0", structure="bottle", robots=2)`
makes it. Gymnasium imports the module by itself if it is named before a colon:
`gymnasium.make("falsework.learn.env.gymnasium_env:falsework/Disassembly-v0")`. It runs one rollout at a time on the
processor and needs no torch; thousands at once are `falsework.learn.env.environment`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States, as_states, describe_action
from falsework.errors import InputError, StateError
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.display.drawing import drawn
from falsework.utils.lazy import importing

with importing("the Gymnasium environment needs gymnasium; pip install 'falsework[learn]'"):
    import gymnasium

ID = "falsework/Disassembly-v0"

_LETTERS = {REMOVED: ".", INSTALLED: "o", HELD: "#"}


class DisassemblyEnv(gymnasium.Env[NDArray[np.int64], np.int64]):
    """Disassembly of a structure by robots that hold parts; every state must be stable (paper, section 5.2).

    Observation: the value of each part, 0 removed, 1 installed, 2 held (`MultiDiscrete`); with a target, followed by
    the values that the parts have there. Action: `i` holds part `i`, `parts + i` removes it (`Discrete`). Reward: +1
    when the target is reached, -1 when an action leaves a state that is not proven stable or no legal action is left,
    else 0; each of these ends the episode. `info["action_mask"]` and `action_masks()` say which actions are legal;
    `info` also has `success`, `unstable` and `illegal`, true for the one that ended the episode.
    """

    metadata = {"render_modes": ["ansi", "rgb_array"], "render_fps": 2}  # noqa: RUF012 - declared so by gymnasium

    def __init__(
        self,
        structure: AnyStructure = "bottle",
        robots: int = 2,
        *,
        starts: StateGraph | ArrayLike | None = None,
        target: ArrayLike | None = None,
        removable_only_if_clear: bool = False,
        fixed: Sequence[int] = (),
        illegal: Literal["end", "error"] = "end",
        oracle: Oracle | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Begin with a structure.

        Args:
            structure: an assembly, the name of a built-in one, or the path of one.
            robots: number of parts that may be held at once.
            starts: stable states that episodes start from, one drawn evenly for each, shape (count, parts), or a state
                graph, of which those are taken that lead to its target; the complete structure if not given.
            target: state to end in, shape (parts,); nothing but boundary and fixed parts if not given.
            removable_only_if_clear: remove a part only if it has a free exit direction.
            fixed: parts that are never touched.
            illegal: what an illegal action does: `end` the episode with reward -1, or raise an `error`.
            oracle: decides stability; pass an existing one to reuse its cache. If not given, one
                of the criterion of the graph, else of the default.
            render_mode: None, `ansi` or `rgb_array`; see `render`.

        Raises:
            InputError: no such structure, fewer than one robot, or another value of `illegal`.
            StateError: a start that is malformed, cannot reach the target under the rules, or no legal action.
        """
        if illegal not in ("end", "error"):
            raise InputError(f"illegal is {illegal!r}; choose 'end' or 'error'")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render mode {render_mode!r} is not supported; choose None, 'ansi' or 'rgb_array'")
        self.assembly = as_assembly(structure)
        self.robots = robots
        self.render_mode = render_mode
        self._illegal = illegal
        if oracle is None:
            known = StabilitySettings(criterion=starts.criterion) if isinstance(starts, StateGraph) else None
            oracle = StabilityOracle(self.assembly, known or StabilitySettings())
        self._oracle: Oracle = oracle
        table = self.assembly.clearance if removable_only_if_clear else None
        whole = Task.from_rules(self.assembly.boundary, robots, target=target, fixed=fixed, clearance=table)
        # Legal moves do not depend on the start, so that one task serves all episodes.
        self._task = whole.judged_by(oracle)
        self._starts = self._check_starts(starts)
        self._shown = target is not None
        parts = self.assembly.part_count
        self.observation_space = gymnasium.spaces.MultiDiscrete([3] * (2 * parts if self._shown else parts))
        self.action_space = gymnasium.spaces.Discrete(2 * parts)
        self._begin(self._starts[0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.int64], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of the draws of start states.
            options: `start`, a state to begin with instead, shape (parts,).

        Raises:
            StateError: a start that is malformed, cannot reach the target under the rules, or no legal action.
        """
        super().reset(seed=seed)
        start = (options or {}).get("start")
        if start is not None:
            self._begin(self._checked(as_states(start, self.assembly.boundary))[0])
        else:
            self._begin(self._starts[self.np_random.integers(len(self._starts))])
        return self._observe(), self._tell()

    def step(self, action: np.int64 | int) -> tuple[NDArray[np.int64], float, bool, bool, dict[str, Any]]:
        """Carry out an action.

        Returns:
            Observation, reward, whether the episode is over, False, and info.

        Raises:
            StateError: an illegal action, if illegal ones are errors.
        """
        action = int(action)
        if not (0 <= action < len(self._mask) and self._mask[action]):
            return self._refuse(action)
        before, actions = self._state, np.array([action])
        self._state = self._task.follow(before[None], actions, Direction.DISASSEMBLY)[0]
        self._mask = self._legal(self._state)
        self._last = describe_action(action, self.assembly.names)
        needed = self._task.needs_verdict(actions, Direction.DISASSEMBLY)[0]
        near = before[None] if self._oracle.holds_keep_stable else None  # as `Environment.stable`
        stands = not needed or bool(self._oracle.verdicts(self._state[None], near=near).stable[0])
        self.fell = not stands
        success = stands and np.array_equal(self._state, self._task.target)
        failed = not stands or (not success and not self._mask.any())
        info = self._tell(success=success, unstable=not stands)
        return self._observe(), float(success) - float(failed), success or failed, False, info

    def action_masks(self) -> Mask:
        """Return the legal actions, shape (2 parts,); under the name that sb3-contrib's MaskablePPO expects."""
        return self._mask.copy()

    def render(self) -> str | NDArray[np.uint8] | None:  # type: ignore[override]
        """Return the state and the last action.

        Returns:
            For `ansi` a line, with a letter for each part: removed `.`, installed `o`, held `#`; for `rgb_array` a
            picture, uint8, shape (height, width, 3).

        Raises:
            DependencyError: for `rgb_array`, Pillow is not installed.
        """
        if self.render_mode is None:
            return None
        if self.render_mode == "rgb_array":
            words = self._last + (", which is not stable" if self.fell else "")
            return drawn("state", self.assembly, self._state, self.robots, words)
        return "".join(_LETTERS[int(value)] for value in self._state) + (f" {self._last}" if self._last else "")

    def _begin(self, state: States) -> None:
        self._state, self._mask = state.copy(), self._legal(state)
        self._last, self.fell = "", False

    def _refuse(self, action: int) -> tuple[NDArray[np.int64], float, bool, bool, dict[str, Any]]:
        if self._illegal == "error":
            raise StateError(f"action {action} is not legal here; choose one that action_masks() allows")
        self._last = f"illegal action {action}"
        return self._observe(), -1.0, True, False, self._tell(illegal=True)

    def _observe(self) -> NDArray[np.int64]:
        shown = [self._state, self._task.target] if self._shown else [self._state]
        return np.concatenate(shown).astype(np.int64)

    def _tell(self, *, success: bool = False, unstable: bool = False, illegal: bool = False) -> dict[str, Any]:
        mask = self._mask.astype(np.int8)
        return {"action_mask": mask, "success": success, "unstable": unstable, "illegal": illegal}

    def _legal(self, state: States) -> Mask:
        return self._task.moves(state[None], Direction.DISASSEMBLY)[0]

    def _check_starts(self, starts: StateGraph | ArrayLike | None) -> States:
        if starts is None:
            states = self._task.start[None]
        elif isinstance(starts, StateGraph):
            left = (starts.states != starts.task.target).any(axis=1)
            states = starts.states[starts.solvable & left]
        else:
            states = as_states(starts, self.assembly.boundary)
        if len(states) == 0:
            raise StateError("there is no start state; give states that lead to the target")
        return self._checked(states)

    def _checked(self, states: States) -> States:
        """Return the start states, checked for a path to the target under the rules and a legal action."""
        between = self._task.contains(states)
        if not between.all():
            row = int(np.argmin(between))
            raise StateError(f"no rule leads from start state {row} to the target; choose another start or target")
        legal = self._task.moves(states, Direction.DISASSEMBLY).any(axis=1)
        if not legal.all():
            row = int(np.argmin(legal))
            raise StateError(f"start state {row} has no legal action; choose one that is not done and not stuck")
        return states


def register() -> None:
    """Make the environment known to Gymnasium, once."""
    if ID not in gymnasium.registry:
        gymnasium.register(id=ID, entry_point="falsework.learn.env.gymnasium_env:DisassemblyEnv")


register()
