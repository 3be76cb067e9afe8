"""Refinement: policy gradients from many short rollouts, begun where imitation has taken the policy.

Imitation of wide searches makes a policy that finds its way from most states in some of many draws. Rollouts from
those states then tell good actions from bad ones, and their successes become known to be solvable and are imitated in
turn. This is PPO (Schulman et al. 2017) with advantages over an estimate of success (Schulman et al. 2016). It differs
from the paper's use of it (section 5.2) in where rollouts start, in batches of thousands of them, and in having no
discount.
"""

from __future__ import annotations

from typing import Any

import torch

from falsework.learn.algorithms.imitation import imitation_loss
from falsework.learn.algorithms.optimizer_state import load_saved, saved_tensors
from falsework.learn.algorithms.transitions import Moves, hindsight, play_and_judge
from falsework.learn.config.policy_gradient import RefineSettings
from falsework.learn.data.random_walks import TaskSource
from falsework.learn.data.solvable_states import SolvedStates
from falsework.learn.env.environment import Environment
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.policy import Policy, masked_log_probabilities
from falsework.utils.collectives import average_gradients, summed
from falsework.utils.distributed import Shards

_FEWEST = 16
"""Rollouts of one collection, at least."""

Known = tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]
"""States to imitate at, their targets, and valid actions; None if there are no targets, or actions are looked up."""


class Refinement:
    """Learns in blocks, as `falsework.learn.training.learners.Learner`."""

    def __init__(
        self,
        environment: Environment,
        policy: Policy,
        solved: SolvedStates,
        starts: torch.Tensor,
        settings: RefineSettings,
        *,
        targets: torch.Tensor | None = None,
        tasks: TaskSource | None = None,
        begin: float = 0.0,
        seed: int = 0,
        precision: str = "float32",
        compiled: bool = False,
        shards: Shards = Shards(),
    ) -> None:
        """Begin with the weights that the policy has.

        Args:
            environment: rules and verdicts.
            policy: what is trained, in place.
            solved: states known to be solvable; grows, unless there are targets.
            starts: states to begin at, like those that the policy is for; solvable, shape (count, parts).
            settings: filled in, see `RefineSettings.resolved`.
            targets: the target of each start, shape (count, parts), or None.
            tasks: draws other starts and targets for every collection, in place of those.
            begin: progress of the whole training at which this begins.
            seed: of starts, rollouts and batches.
            precision: of the network.
            compiled: compile the network for its updates.
            shards: processes that share rollouts and average their gradients.
        """
        self.exhausted = False
        self.steps = 0
        """Steps of the optimizer taken."""
        self._environment, self._solved, self._settings, self._shards = environment, solved, settings, shards
        self._starts, self._targets, self._tasks, self._begin = starts, targets, tasks, begin
        self._policy = policy
        self._network = Network(policy, precision, compiled=compiled)
        self._playing = Network(policy, precision)
        self._weights = [weight for weight in policy.parameters() if weight.requires_grad]
        self._optimizer: Any = torch.optim.AdamW(
            self._weights, lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True
        )
        self._average = [weight.detach().clone() for weight in self._weights]
        self._generator = environment.generator(seed * 1009 + 700 + shards.rank)
        self._failed = starts[:0]
        self._failed_targets = None if targets is None else targets[:0]
        self._passed = (starts[:0], starts[:0])
        self._numbers: dict[str, float] = {}
        some = slice(None, None, max(len(starts) // 4096, 1))
        left = environment.rules.steps_left(starts[some], None if targets is None else targets[some])
        self._length = max(float(left.double().mean()), 1.0) if len(left) else 1.0

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """Take some steps of the optimizer, with as many rollouts as they need.

        Args:
            steps: how many.
            progress: of the whole training, before and after.

        Returns:
            Numbers to log.
        """
        left = steps
        share = self._settings.batch // self._shards.size
        while left:
            moves = self._collect(left * share)
            # All processes take the same number of steps, since they exchange gradients at each.
            count = int(-summed([-float(len(moves) // share)], self._shards, self._environment.device)[0])
            count = max(count // self._shards.size, 1)
            done = 1.0 - left / steps
            place = progress[0] + (progress[1] - progress[0]) * done
            took = min(count, left)
            self._update(moves, took, share, place)
            left -= took
        return {**self._numbers, "solved": float(len(self._solved))}

    def best(self, policy: Policy) -> Policy:
        """Write the moving average of the weights into another policy of the same kind."""
        with torch.no_grad():
            weights = [weight for weight in policy.parameters() if weight.requires_grad]
            for weight, average in zip(weights, self._average, strict=True):
                weight.copy_(average)
        return policy.eval()

    def adopt(self, policy: Policy) -> None:
        """Begin with the weights of another policy of the same kind, such as what imitation arrived at."""
        self._policy.load_state_dict(policy.state_dict())
        with torch.no_grad():
            for average, weight in zip(self._average, self._weights, strict=True):
                average.copy_(weight)

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that there is to save and is the same in all processes."""
        saved = saved_tensors(self._policy, self._optimizer, self._average)
        return {**saved, "steps": torch.tensor([self.steps])}

    def own_tensors(self) -> dict[str, torch.Tensor]:
        """All that there is to save and belongs to this process."""
        saved = {"generator": self._generator.get_state(), "failed": self._failed}
        if self._failed_targets is None:
            return saved
        passed = {"passed": self._passed[0], "passed_targets": self._passed[1]}
        return {**saved, **passed, "failed_targets": self._failed_targets}

    def load(self, tensors: dict[str, torch.Tensor], own: dict[str, torch.Tensor] | None) -> None:
        """Go back to what was saved; `own` is None if the number of processes has changed."""
        load_saved(tensors, self._policy, self._optimizer, self._average)
        self.steps = int(tensors["steps"][0])
        if own is None:
            self._generator.manual_seed(100_003 * (self.steps + 1) + self._shards.rank)
            return
        self._generator.set_state(own["generator"].cpu())
        self._failed = own["failed"].to(self._starts.device)
        if self._failed_targets is not None:
            device = self._starts.device
            self._failed_targets = own["failed_targets"].to(device)
            self._passed = (own["passed"].to(device), own["passed_targets"].to(device))

    def _draw(self, count: int, among: int) -> torch.Tensor:
        return torch.randint(max(among, 1), (count,), generator=self._generator, device=self._starts.device)

    def _choose_starts(self, wanted: int) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Starts of one collection: from the data, recent failures, and all that is solvable or was passed."""
        settings = self._settings
        # No more rollouts than the steps to come can learn from, such as those of a slow network in its last minute.
        count = max(min(settings.rollouts // self._shards.size, round(wanted / self._length)), _FEWEST)
        failures = round(count * settings.from_failures) if len(self._failed) else 0
        if self._targets is None or self._failed_targets is None:
            anywhere = count - round(count * (settings.from_data + settings.from_failures))
            pieces = [
                self._starts[self._draw(count - failures - anywhere, len(self._starts))],
                self._failed[self._draw(failures, len(self._failed))],
                self._solved.states[self._draw(anywhere, len(self._solved))],
            ]
            return torch.cat(pieces), None
        passed = round(count * settings.from_hindsight) if len(self._passed[0]) else 0
        drawn = [
            (self._failed, self._failed_targets, self._draw(failures, len(self._failed))),
            (*self._passed, self._draw(passed, len(self._passed[0]))),
        ]
        pairs = [(states[rows], targets[rows]) for states, targets, rows in drawn]
        fresh = count - failures - passed
        if self._tasks is None:
            rows = self._draw(fresh, len(self._starts))
            pairs.append((self._starts[rows], self._targets[rows]))
        else:
            pairs.append(self._tasks.draw(fresh, self._generator)[:2])
        return torch.cat([states for states, _ in pairs]), torch.cat([targets for _, targets in pairs])

    def _collect(self, wanted: int) -> Moves:
        """Play, remember failures and solvable states, and keep the moves that may be learned from."""
        settings = self._settings
        starts, targets = self._choose_starts(wanted)
        self._policy.eval()
        moves = play_and_judge(self._environment, self._playing, starts, targets, settings.trace, self._generator)
        failed = ~moves.success
        most = 4 * settings.rollouts // self._shards.size
        self._failed = torch.cat([starts[failed], self._failed])[:most]
        if self._failed_targets is not None and targets is not None:
            self._failed_targets = torch.cat([targets[failed], self._failed_targets])[:most]
            fresh = hindsight(moves, len(starts), self._generator)
            seen = self._solved.is_forbidden(fresh[0]) | self._solved.is_forbidden(fresh[1])
            learnable = (~seen).nonzero()[:, 0]
            states, later = (
                torch.cat([new[learnable], old])[:most] for new, old in zip(fresh, self._passed, strict=True)
            )
            self._passed = (states, later)
        if targets is None and len(moves) and len(self._solved) < settings.most_solved:
            self._solved.add(moves.states[moves.success[moves.rollout]])
        # What is kept for testing is not learned from, not even by trial.
        moves = moves.take((~self._solved.is_forbidden(moves.states)).nonzero()[:, 0])
        tried, well, steps = summed(
            [float(len(starts)), float(moves.success.sum()), float(len(moves))], self._shards, starts.device
        )
        self._numbers |= {"rollout_success": well / max(tried, 1.0), "rollout_moves": steps}
        return moves

    def _update(self, moves: Moves, steps: int, share: int, progress: float) -> None:
        settings = self._settings
        self._policy.train()
        order = torch.randperm(len(moves), generator=self._generator, device=self._starts.device)
        scale = moves.advantage.std(correction=0) + 1e-6 if len(moves) else torch.ones((), device=order.device)
        through = min(max((progress - self._begin) / max(1.0 - self._begin, 1e-9), 0.0), 1.0)
        rate = settings.learning_rate * (1.0 - (1.0 - settings.least_learning_rate) * through)
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        sums = torch.zeros(4, device=order.device)
        every: Any = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
        known = self._known(steps)
        for step in range(steps):
            rows = order[step * share : (step + 1) * share]
            loss, numbers = self._loss(moves.take(rows), scale, None if known is None else known[step])
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()
            average_gradients(self._weights, self._shards)
            norm = torch.nn.utils.clip_grad_norm_(self._weights, settings.clip, foreach=True)
            self._optimizer.found_inf = (~norm.isfinite()).float()  # a step that is not finite is left out
            self._optimizer.step()
            self.steps += 1
            every(self._average, [weight.detach() for weight in self._weights], 1.0 - settings.average)
            sums += numbers
        self._policy.eval()
        loss, entropy, error, drift = (sums / steps).tolist()
        self._numbers |= {"loss": loss, "entropy": entropy, "value_error": error, "drift": drift, "rate": rate}

    def _known(self, steps: int) -> list[Known] | None:
        """What is imitated in some steps; None if nothing is."""
        settings = self._settings
        count = max(round(settings.batch * settings.imitation_share / self._shards.size), 1)
        if settings.imitation == 0:
            return None
        if self._tasks is not None:
            states, targets, valid = self._tasks.draw(steps * count, self._generator)
            return list(zip(states.split(count), targets.split(count), valid.split(count), strict=True))
        if self._targets is not None or len(self._solved) == 0:
            return None
        rows = (self._draw(count, len(self._solved)) for _ in range(steps))
        return [(self._solved.states[some], None, None) for some in rows]

    def _loss(self, moves: Moves, scale: torch.Tensor, known: Known | None) -> tuple[torch.Tensor, torch.Tensor]:
        settings = self._settings
        states, targets = moves.states, moves.targets
        if known is not None:
            states = torch.cat([states, known[0]])
            targets = None if targets is None or known[1] is None else torch.cat([targets, known[1]])
        logits, value = self._network(states, targets)
        size = len(moves)
        logs = masked_log_probabilities(logits[:size], moves.mask)
        ratio = torch.exp(logs.gather(1, moves.actions[:, None])[:, 0] - moves.log_probability)
        gain = moves.advantage / scale
        low, high = 1.0 - settings.clip_ratio, 1.0 + settings.clip_ratio
        count = max(size, 1)
        surrogate = -torch.minimum(ratio * gain, ratio.clamp(low, high) * gain).sum() / count
        entropy = -(logs.exp() * torch.where(moves.mask, logs, 0.0)).sum() / count
        chance = 0.5 + 0.4999 * value[:size]  # never 0 nor 1, whose logarithm would be infinite
        error = torch.nn.functional.binary_cross_entropy(chance, moves.chance, reduction="sum") / count
        loss = surrogate - settings.entropy * entropy + settings.value * error
        if known is not None:
            right, aims, valid = known
            mask = self._environment.rules.moves(right, aims)
            valid = self._solved.valid_actions(right, mask) if valid is None else valid
            loss = loss + settings.imitation * imitation_loss(logits[size:], mask, valid)
        drift = (moves.log_probability.sum() - logs.gather(1, moves.actions[:, None]).sum()) / count
        return loss, torch.stack([loss, entropy, error, drift]).detach()
