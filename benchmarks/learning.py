"""Train policies and evaluate them by the paper's protocols: one JSON object per line.

    python benchmarks/learning.py table3 --method reinforcement --data width64 --criterion equilibrium --out FILE
    python benchmarks/learning.py table3 --rows vault-62:2 --seeds 0 --keep runs
    python benchmarks/learning.py table4 --rows bottle-12:2 dome-37:2
    python benchmarks/learning.py table5 --rows bottle-12:2
    python benchmarks/learning.py transfer
    python benchmarks/learning.py searches --searches folder         # all draws of table3, once for many runs
    python benchmarks/learning.py searches --goals yes --searches folder    # those of table4
    torchrun --nproc-per-node 4 benchmarks/learning.py table3 --rows vault-62:6

A row is a structure, by the name of a real one (FALSEWORK_DATA, else the folder `shared` beside the repository), of a
built-in one or by its path, and a number of robots. `table3`: greedy success on the
test states of five searches (`draws.py`), all of them or `--states` of each, with their distance to the states learned
from, and `paper` where the paper has the row; `--data width64` learns from the paper's data alone. Runs whose records
are in the file of `--out` are skipped, those in the folder of `--keep` are resumed. `table4`: a goal-conditioned
policy, a goal-blind one, or both (`--goals`), on two draws of unseen pairs. `table5`: `gat`, `transformer`, `resmlp`
and `mlp` with the same budget. `transfer`: a policy of the bottle evaluated on the dog.
`solvable`: how many states of a small structure are solvable, and how many of them no run may learn from.
`minutes` is the total budget, `seconds` the time used; data are included but for `table3`, evaluation is not. Rows
are independent: run them as processes of their own, each with its CUDA_VISIBLE_DEVICES.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import record
from baselines.uniform import UniformPolicy
from draws import Searches, success_on_draws, test_seeds
from states import find

from falsework import StabilityOracle, StabilitySettings, load_structure, train
from falsework.errors import InputError
from falsework.learn import Environment, Policy, PolicySettings, TrainSettings, roll_out, transfer
from falsework.learn.config.policy import recommended
from falsework.learn.config.train import METHODS, Criterion, from_dict, phases_of
from falsework.learn.data.dataset import Dataset, build_dataset, search_states, training_task
from falsework.learn.data.goal_dataset import GoalDataset, GoalDataSettings, SearchStates, build_goal_dataset
from falsework.learn.data.goal_pairs import Pairs
from falsework.learn.data.symmetry import symmetries
from falsework.learn.data.symmetry_augmentation import symmetric_images
from falsework.learn.networks.autocast import Network
from falsework.learn.training.evaluate import measure_success, sample
from falsework.learn.training.train import TrainResult
from falsework.search.device.oracle import TensorOracle, tensor_oracle
from falsework.search.problem.hashing import StateIndex
from falsework.utils.distributed import ProcessGroup, init_distributed
from falsework.utils.tensors import choose_device, put

TABLE_3: dict[str, tuple[float, float, float, float]] = {
    "bottle-12:2": (95.7, 86.5, 0.28, 2),
    "tetris-17:2": (98.0, 92.6, 0.25, 2),
    "tetris-14:2": (94.3, 86.6, 0.21, 2),
    "tetris-13:2": (97.3, 92.3, 0.15, 2),
    "dog-35:2": (99.2, 99.0, 1.14, 5),
    "dome-37:2": (97.4, 91.0, 1.6, 5),
    "vault-62:2": (92.3, 38.9, 21.3, 20),
    "vault-62:3": (97.9, 53.4, 9.5, 20),
    "vault-62:4": (96.2, 69.0, 9.0, 20),
    "vault-62:5": (94.6, 70.8, 9.0, 20),
    "vault-62:6": (91.2, 78.4, 9.0, 20),
    "dome-72:2": (97.6, 96.4, 16.05, 15),
}
"""For each row the paper's success in training and test in %, its hours, and the minutes of a run here."""
EVERYTHING = 1 << 14
"""Width of a search that finds all states of a small structure."""
SECOND_DRAW = 5000
"""Seed of the searches from which a second set of unseen pairs is drawn."""
SMALL = 20
"""Number of parts up to which every test draw has a run of its own."""


def rows_of(options: argparse.Namespace) -> Iterator[tuple[str, Any, int, tuple[int, ...]]]:
    """Yield name, structure, robots and seeds of every row."""
    for row in options.rows or TABLE_3:
        name, _, robots = row.rpartition(":")
        if not robots.isdigit():
            name, robots = row, "2"
        if not options.rows and find(name) == name:
            continue  # the real structures are not on this machine
        assembly = load_structure(find(name))
        seeds = tuple(options.seeds) or (0, 1, 2)
        yield name, assembly, int(robots), seeds


def settings_of(options: argparse.Namespace, row: str, robots: int, seed: int, **changes: Any) -> TrainSettings:
    """Return the settings of the command line, with the budget of the row."""
    target = TABLE_3.get(f"{row}:{robots}")
    minutes = options.minutes or (target[3] if target and options.device != "cpu" else 0.0)
    given: dict[str, Any] = {"robots": robots, "seed": seed, "minutes": minutes, "steps": options.steps}
    given |= {"data": options.data, "widths": tuple(options.widths), "criterion": options.criterion}
    given["removable_only_if_clear"] = options.clear
    given["phases"] = phases_of(options.method, begun=bool(options.begin))
    if options.policy:
        given["policy"] = PolicySettings(options.policy)
    if options.imitation_steps is not None:
        first, *others = given["phases"]
        given["phases"] = (replace(first, steps=options.imitation_steps), *others)  # type: ignore[call-arg]
    if options.set:
        *others, last = given["phases"]
        changed = {name: json.loads(value) for name, _, value in (one.partition("=") for one in options.set)}
        given["phases"] = (*others, from_dict(type(last), asdict(last) | changed))
    given |= changes
    sizes = {name: getattr(options, name) for name in ("layers", "channels", "heads") if getattr(options, name)}
    return TrainSettings(**{**given, "policy": replace(given.get("policy", PolicySettings()), **sizes)})


def run(
    options: argparse.Namespace,
    name: str,
    assembly: Any,
    settings: TrainSettings,
    label: str,
    dataset: Dataset | GoalDataset | None = None,
) -> TrainResult:
    """Train, with progress on standard error."""
    last = time.perf_counter()

    def show(done: float, text: str) -> None:
        nonlocal last
        if not options.quiet and time.perf_counter() - last > 10 and ProcessGroup.from_torch().is_main_process:
            last = time.perf_counter()
            sys.stderr.write(f"{label}: {100 * done:5.1f} % {text}\n")

    folder = None
    if options.keep:
        folder = Path(options.keep) / label.replace(":", "-").replace(" ", "-").replace("/", "-")
    source = {"path": str(Path(find(name)).resolve())} if find(name) != name else {"built_in": name}
    return train(
        assembly,
        settings,
        folder=folder,
        begin=options.begin or None,
        source=source,
        device=options.device,
        resume=folder is not None and (folder / "run.json").exists(),
        report=show,
        dataset=dataset,
    )


def evaluated(
    options: argparse.Namespace,
    result: TrainResult,
    settings: TrainSettings,
    assembly: Any,
    pairs: dict[str, Pairs] | None = None,
) -> dict[str, Any]:
    """Return greedy success on all states of both sets, or on pairs, and that of random legal actions."""
    device = next(result.policy.parameters()).device
    filled = settings.resolved(assembly.part_count, device.type)
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=settings.criterion))
    clearance = settings.removable_only_if_clear
    environment = Environment(
        assembly, settings.robots, oracle=oracle, device=device, removable_only_if_clear=clearance
    )
    network: Any = Network(result.policy, filled.precision)
    sets: Any = {name: (one.states, one.targets) for name, one in (pairs or {}).items()}
    if not sets:
        data = protocol(assembly, settings, tensor_oracle(oracle, device), str(device))
        sets = {"train": (data.train, None), "test": (data.test, None)}
    shards = ProcessGroup.from_torch()
    environment.exact = sets["test"][1] is None  # of goals, states that a GPU leaves open count as failures
    found = measure_success(environment, network, sets, most=options.states, search=options.search, shards=shards)
    for name, (states, targets) in sets.items():
        rows = sample(np.arange(len(states)), options.states)
        tensors = put(states[rows], device), None if targets is None else put(targets[rows], device)
        generator = environment.generator(settings.seed)
        drawn = roll_out(environment, UniformPolicy(), *tensors, greedy=False, generator=generator, keep="ends")
        found[name]["random"] = round(float(drawn.success.float().mean()), 6)
        if tensors[1] is not None:
            ended = roll_out(environment, network, *tensors, keep="ends", checked=True)
            found[name]["checked"] = round(float(ended.success.float().mean()), 6)
            found[name]["steps"] = record.spread(environment.rules.steps_left(*tensors).tolist())
    everything = "all states" if sets["test"][1] is None else "all unseen pairs"
    return {**found, "evaluated": f"at most {options.states} of each set" if options.states else everything}


def goal_data(
    options: argparse.Namespace, assembly: Any, settings: TrainSettings, device: Any
) -> tuple[GoalDataset, dict[str, Pairs]]:
    """Return what a policy with goals learns from, and the pairs that it is evaluated on.

    Those of `second` are of searches of their own; neither of their states is in the data. Searches are kept in the
    folder of --searches.
    """
    filled = settings.resolved(assembly.part_count, device.type)
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=settings.criterion))
    judge = tensor_oracle(oracle, device)
    task = training_task(assembly, settings.robots, settings.removable_only_if_clear).judged_by(judge)
    found = []
    for seed, widths in ((0, filled.widths if settings.data == "wide" else ()), (SECOND_DRAW, ())):
        name = f"pairs-{assembly.name}-{settings.robots}-{settings.criterion}-{seed}-{len(widths)}.npz"
        path = Path(options.searches) / name if options.searches else None
        searches = GoalDataSettings(widths=widths, seed=seed)
        if path is not None and path.exists():
            searched = SearchStates.load(path, task)
        else:
            searched = SearchStates.find(task, searches, judge, device=device)
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                searched.save(path, task)
        found.append(build_goal_dataset(assembly, task, searches, oracle=judge, device=str(device), searched=searched))
    first, other = found[0], found[1].test
    index = StateIndex(first.wide.states)
    other = other[(index.find(other.states) < 0) & (index.find(other.targets) < 0)]
    return first, {"train": first.train, "test": first.test, "second": other}


def protocol(assembly: Any, settings: TrainSettings, oracle: TensorOracle, device: str) -> Dataset:
    """Return the two sets of the paper's protocol; the same states as in training, since the seed is the same."""
    task = training_task(assembly, settings.robots, settings.removable_only_if_clear)
    return build_dataset(assembly, task, oracle=oracle, device=device)


def line(
    benchmark: str, name: str, settings: TrainSettings, result: TrainResult, found: dict[str, Any], **more: Any
) -> None:
    """Print one row."""
    paper = TABLE_3.get(f"{name}:{settings.robots}")
    known: dict[str, Any] = {}
    if paper and benchmark == "draws":
        known["paper"] = {"train": paper[0] / 100, "test": paper[1] / 100, "hours": paper[2]}
    if not ProcessGroup.from_torch().is_main_process:
        return
    filled = settings.resolved(result.policy.part_count, next(result.policy.parameters()).device.type)
    record.report(
        f"learning {benchmark}",
        structure=name,
        robots=settings.robots,
        seeds=(settings.seed,),
        data=settings.data,
        criterion=settings.criterion,
        clear=settings.removable_only_if_clear,
        phases=[phase.algorithm for phase in settings.phases],
        ppo={
            name: getattr(filled.phases[-1], name, None)
            for name in ("starts", "rollouts", "epochs", "anywhere", "explored", "imitation", "removals")
        },
        policy=result.policy.settings.kind,
        goal_conditioned=settings.policy.goal_conditioned,
        validation=result.validation.to_dict(),
        **found,
        **known,
        seconds=round(result.seconds, 1),
        data_seconds=round(result.data_seconds, 1),
        training_seconds=round(result.seconds - result.data_seconds, 1),
        steps=result.steps,
        states_learned_from=result.solved,
        held_out_visit_rate=round(result.held_out_visit_rate, 4),
        device=next(result.policy.parameters()).device,
        processes=result.processes,
        environment=result.throughput,
        notes=result.notes,
        **more,
    )


def table3(options: argparse.Namespace) -> None:
    """Measure greedy success from the unseen states of several draws of the searches; finished runs are skipped."""
    device = choose_device(options.device)
    for name, assembly, robots, seeds in rows_of(options):
        oracle = tensor_oracle(StabilityOracle(assembly, StabilitySettings(criterion=options.criterion)), device)
        folder = Path(options.searches) if options.searches else None
        searches = Searches(assembly, robots, options.clear, oracle, device, folder)
        for seed in seeds:
            # Of a small structure five test draws would hold out most of the solvable states.
            several = assembly.part_count > SMALL
            numbers = options.tests or range(len(test_seeds(seed)))
            for tests in (test_seeds(seed),) if several else tuple((test_seeds(seed)[n],) for n in numbers):
                settings = settings_of(options, name, robots, seed, policy=kind_of(options, assembly))
                about = {"structure": name, "robots": robots, "seeds": [seed], "data": settings.data}
                about |= {"criterion": settings.criterion, "tests": list(tests), "label": options.label}
                about["clear"] = options.clear
                if finished(options.out, about):
                    continue
                begun = time.perf_counter()
                filled = settings.resolved(assembly.part_count, device.type)
                draw = searches.draw(seed, tests, filled.widths if settings.data == "wide" else ())
                label = f"{name}:{robots} {settings.data} {settings.criterion} seed {seed} {options.label}"
                label += "" if several else f" test {tests[0]}"
                searched = time.perf_counter() - begun
                result = run(options, name, assembly, settings, label, draw.dataset)
                if result.interrupted:
                    return
                found = success_on_draws(assembly, settings, result.policy, draw, most=options.states)
                more = {"tests": list(tests), "label": options.label, "search_seconds": round(searched, 1)}
                line("draws", name, settings, result, found, **more)


def kind_of(options: argparse.Namespace, assembly: Any) -> PolicySettings:
    """Return the network of the command line, or the one recommended."""
    return recommended(assembly.part_count, kind=options.policy or None)


def finished(out: Path | None, about: dict[str, Any]) -> bool:
    """Return whether the file of records has a run."""
    if out is None or not out.exists():
        return False
    records = (json.loads(text) for text in out.read_text(encoding="utf-8").splitlines())
    return any(all(one.get(key) == value for key, value in about.items()) for one in records)


def searched(options: argparse.Namespace) -> None:
    """Search for the states of all draws of the rows, or for pairs, into the folder of --searches."""
    device = choose_device(options.device)
    for name, assembly, robots, seeds in rows_of(options):
        oracle = tensor_oracle(StabilityOracle(assembly, StabilitySettings(criterion=options.criterion)), device)
        searches = Searches(assembly, robots, options.clear, oracle, device, Path(options.searches or "searches"))
        for width, seed in () if options.goals == "yes" else searches.all_seeds(seeds):
            searches.states(width, seed)
        if options.goals == "yes":
            kind = recommended(assembly.part_count, goal_conditioned=True)
            goal_data(options, assembly, settings_of(options, name, robots, 0, policy=kind), device)


def table4(options: argparse.Namespace) -> None:
    """Measure greedy success from states to other states, goal-conditioned and goal-blind."""
    for name, assembly, robots, seeds in rows_of(options):
        for seed in seeds:
            for two in {"both": (True, False), "yes": (True,), "no": (False,)}[options.goals]:
                kind = recommended(assembly.part_count, goal_conditioned=two, kind=options.policy or None)
                settings = settings_of(options, name, robots, seed, policy=kind)
                label = f"{name}:{robots} {'two states' if two else 'one state'} seed {seed} {options.label}"
                begun = time.perf_counter()
                device = choose_device(options.device)
                data, pairs = goal_data(options, assembly, settings, device)
                searched = round(time.perf_counter() - begun, 1)
                if two and not settings.steps:
                    minutes = settings.resolved(assembly.part_count, device.type).minutes
                    settings = replace(settings, minutes=max(minutes - searched / 60, 0.1))
                result = run(options, name, assembly, settings, label, data if two else None)
                if result.interrupted:
                    return
                found = evaluated(options, result, settings, assembly, pairs)
                line("table4", name, settings, result, found, label=options.label, search_seconds=searched)


def table5(options: argparse.Namespace) -> None:
    """Compare networks with the same budget."""
    for name, assembly, robots, seeds in rows_of(options):
        for seed in seeds:
            for kind in (options.policy,) if options.policy else ("resmlp", "transformer", "gat", "mlp"):
                settings = settings_of(options, name, robots, seed, policy=recommended(assembly.part_count, kind=kind))
                result = run(options, name, assembly, settings, f"{name}:{robots} {kind} seed {seed}")
                line("table5", name, settings, result, evaluated(options, result, settings, assembly))


def carry_over(options: argparse.Namespace) -> None:
    """Evaluate a policy trained on one structure on another (paper: bottle to dog, 66 %)."""
    source, goal = options.rows or ("bottle-12:2", "dog-35:2")
    name, _, robots = source.rpartition(":")
    other = load_structure(find(goal.rpartition(":")[0]))
    assembly = load_structure(find(name))
    for seed in options.seeds or (0,):
        kind = PolicySettings(options.policy or "transformer")
        settings = settings_of(options, name, int(robots), seed, policy=kind)
        result = run(options, name, assembly, settings, f"{name} seed {seed}")
        device = next(result.policy.parameters()).device
        moved: Policy = transfer(result.policy.state_dict(), settings.policy, other, device)
        there = replace(result, policy=moved.eval())
        found = evaluated(options, there, settings, other)
        line("transfer", name, settings, result, found, asked_about=goal.rpartition(":")[0], paper_train=0.66)


def solvable(options: argparse.Namespace) -> None:
    """Count all solvable states of small structures, and those that no run may learn from."""
    device = choose_device(options.device)
    for name, assembly, robots, _ in rows_of(options):
        settings = settings_of(options, name, robots, 0)
        oracle = tensor_oracle(StabilityOracle(assembly, StabilitySettings(criterion=settings.criterion)), device)
        data = protocol(assembly, settings, oracle, str(device))
        states, found = search_states(data.task, oracle, EVERYTHING, 0, device=device)
        if not found or np.bincount(data.task.steps_done(states)).max() == EVERYTHING:
            raise InputError(f"{name} has more states than a search of width {EVERYTHING} keeps; name a smaller one")
        held_out = symmetric_images(np.concatenate([data.test, data.validation]), symmetries(assembly))
        unsolvable = int((StateIndex(states).find(held_out) < 0).sum())
        record.report(
            "learning solvable", structure=name, robots=robots, criterion=settings.criterion, states=len(states),
            held_out=len(held_out), held_out_unsolvable=unsolvable, device=device,
        )  # fmt: skip


def main() -> None:
    """Read the command line and run a benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    whats = {"table3": table3, "searches": searched, "table4": table4, "table5": table5, "transfer": carry_over}
    whats["solvable"] = solvable
    parser.add_argument("what", choices=list(whats))
    parser.add_argument("--rows", nargs="*", default=[], help="structure:robots; all of the table if not given")
    parser.add_argument("--seeds", nargs="*", type=int, default=[], help="default: 0 1 2")
    parser.add_argument("--minutes", type=float, default=0.0, help="default: the budget of the table")
    parser.add_argument("--steps", type=int, default=0, help="in place of minutes")
    parser.add_argument("--data", choices=("wide", "width64"), default="wide")
    parser.add_argument("--criterion", choices=get_args(Criterion), default="contact", help="stability criterion")
    parser.add_argument("--clear", action="store_true", help="remove a part only if it has a free straight exit")
    parser.add_argument("--widths", nargs="*", type=int, default=[], help="widths of the wide searches")
    parser.add_argument("--method", choices=METHODS, default="default")
    parser.add_argument("--imitation-steps", type=int, help="imitation steps before PPO; 0 for no limit")
    parser.add_argument("--set", nargs="*", default=[], help="settings of PPO in JSON, such as epochs=2")
    parser.add_argument("--policy", choices=("resmlp", "transformer", "gat", "mlp"), default="")
    parser.add_argument("--layers", type=int, default=0, help="layers of the network; 0 for the default")
    parser.add_argument("--channels", type=int, default=0, help="channels of the network; 0 for the default")
    parser.add_argument("--heads", type=int, default=0, help="attention heads; 0 for the default")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--states", type=int, default=0, help="states evaluated of each set; 0 for all")
    parser.add_argument("--searches", default="", help="folder that keeps the searches of table3 and table4")
    parser.add_argument(
        "--tests", nargs="*", type=int, default=[], help="numbers of the test draws of small structures; default: all"
    )
    parser.add_argument("--label", default="", help="name of a variant in the records of table3 and table4")
    parser.add_argument(
        "--goals",
        choices=("both", "yes", "no"),
        default="both",
        help="which policies table4 trains; yes: pairs for searches",
    )
    parser.add_argument("--search", action="store_true", help="search where the policy fails")
    parser.add_argument("--begin", default="", help="run whose weights and network to begin with")
    parser.add_argument("--keep", default="", help="folder for the runs; existing ones are resumed")
    parser.add_argument("--out", type=Path, help="file to which the records are appended")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    options = parser.parse_args()
    record.write_to(options.out)
    with init_distributed(options.device):
        whats[options.what](options)


if __name__ == "__main__":
    main()
