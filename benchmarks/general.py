"""One policy for structures that it has never seen: its data, training, evaluation and model card.

    python benchmarks/general.py make --folder out/general --minutes 9 --processes 15 --device cuda
    python benchmarks/general.py data --folder out/general --minutes 30 --processes 2
    python benchmarks/general.py reinforce --folder out/general --minutes 9 --total 8 --processes 15 --device cuda
    python benchmarks/general.py evaluate --folder out/general --processes 15 --minutes 9 --device cuda
    python benchmarks/general.py guide --folder out/general --processes 15 --minutes 9
    python benchmarks/general.py card --folder out/general --out benchmarks/results/general.jsonl

`make` generates structures on the processor while it trains on the data so far; repeat the same command until it says
that training is done. Once some training is done, the processes roll the policy out: what succeeds becomes data, and
states from which it fails come first. `data` does the first half alone. `reinforce` goes on with reinforcement: the
processes roll out on structures of the data, from states of a wide search of their own, and first on those where
rollouts fail; in a folder with data and a run but no checkpoint, they begin with the weights of the run. Half of the
GPUs evaluate the network for them, a process for each of the others learns. `evaluate` tests on structures that are not
trained on, and stops in time; repeat it until no case is left. `guide` searches for plans with the policy as a guide,
and without. `card` summarises both by groups.

The folder holds `data-*.npz`, `validation.npz`, a run that other commands take (`run.json`, `weights.safetensors`), a
checkpoint, `log.jsonl`, `evaluation.jsonl` and `guides.jsonl`; in `starts`, states of wide searches.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
import tyro
from experiments.general_cases import CASES, VALIDATION, evaluate_case, guide_case
from experiments.general_ppo import GeneralPpo, GeneralPpoSettings
from experiments.general_training import GeneralSettings, GeneralTraining
from experiments.inference import Inference, RemotePolicy
from experiments.labelled_states import (
    LabelledStructure,
    LabelSettings,
    label_states,
    load_labelled,
    save_labelled,
)
from experiments.structure_batches import StructureBatches
from experiments.structure_generator import TRAINED, generated, named
from record import report, spread, write_to

from falsework import Assembly, load_policy, load_structure
from falsework.errors import FalseworkError, InputError
from falsework.learn import PolicySettings
from falsework.learn.networks.local_attention import LocalAttentionPolicy
from falsework.utils.collectives import decided, summed
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import choose_device

PER_FILE = 1000
"""Structures of one file of data."""
VALIDATED = 64
"""Structures to validate on."""
REPORT_EVERY = 30.0
"""Seconds of training between two looks at the data."""
AVERAGE_EVERY = 3.0
"""Seconds of reinforcement between two times that processes average their weights."""
SUMS = ("collections", "moves", "success", "updates", "entropy", "divergence")
"""What reinforcement counts: rollouts with the same weights on one structure, their actions, steps of the optimizer."""
VALIDATE = 30.0
"""Seconds for greedy success on validation structures, at most."""
SAVE_EVERY, RESERVE = 120.0, 40.0
"""Seconds between two times that all data are written, and for the last time at the end of a call."""
IMPROVE_AFTER = 0.3
"""Share of the training after which the policy is rolled out."""


@dataclass(frozen=True)
class Options:
    """What to do, and for how long."""

    what: tyro.conf.Positional[Literal["make", "data", "reinforce", "evaluate", "guide", "card"]]
    """Command."""
    folder: Path = Path("out/general")
    """Folder of data, checkpoint and results."""
    minutes: float = 9.0
    """Time of this call, start included."""
    total: float = 60.0
    """For `make` and `reinforce`: minutes of training in all calls together, over which the learning rate falls."""
    processes: int = 1
    """Processes that generate, roll out or evaluate."""
    structures: int = 4000
    """Structures to generate; from then on, or later in training, known ones are improved."""
    families: tuple[str, ...] = TRAINED
    """For `data`: families of the structures to generate."""
    cases: tuple[str, ...] = ()
    """For `evaluate` and `guide`: groups, or beginnings of the names of cases; all if not given."""
    layers: int = 0
    """Layers of the network; 0 for the default."""
    channels: int = 0
    """Channels of the network; 0 for the default."""
    tokens: int = 0
    """Parts of all states of a batch; 0: 131,072 on a GPU, 4,096 on a processor."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train."""
    seed: int = 0
    """Of weights and batches."""
    out: Path | None = None
    """For `card`: file to which records are appended."""


@dataclass
class Library:
    """Structures with labels by number, in files of a folder."""

    folder: Path
    structures: dict[int, LabelledStructure] = field(default_factory=dict)
    validation: dict[int, LabelledStructure] = field(default_factory=dict)
    failed: set[int] = field(default_factory=set)
    """Numbers of structures that were not solved."""

    @staticmethod
    def load(folder: Path) -> Library:
        """Read what there is."""
        library = Library(folder)
        for path in sorted(folder.glob("data-*.npz")):
            found, about = load_labelled(path)
            library.structures |= {number_of(one): one for one in found}
            library.failed |= set(about["failed"])
        if (folder / "validation.npz").exists():
            found, about = load_labelled(folder / "validation.npz")
            library.validation = {number_of(one): one for one in found}
            library.failed |= set(about["failed"])
        return library

    def save(self) -> None:
        """Write all files anew."""
        ordered = [self.structures[number] for number in sorted(self.structures)]
        failed = sorted(number for number in self.failed if number < VALIDATION)
        for begin in range(0, len(ordered), PER_FILE):
            about = {"failed": failed if begin == 0 else []}
            save_labelled(ordered[begin : begin + PER_FILE], self.folder / f"data-{begin // PER_FILE:02}.npz", about)
        if self.validation:
            about = {"failed": sorted(number for number in self.failed if number >= VALIDATION)}
            save_labelled(list(self.validation.values()), self.folder / "validation.npz", about)

    def add(self, number: int, found: LabelledStructure | None) -> None:
        """Keep labels, or that there are none."""
        if found is None:
            self.failed.add(number)
        else:
            (self.validation if number >= VALIDATION else self.structures)[number] = found


def number_of(one: LabelledStructure) -> int:
    """Return the number of a generated structure."""
    return int(one.name.rpartition("-")[2])


class Generator:
    """Processes that label structures, new ones or known ones with rollouts of the policy."""

    def __init__(self, library: Library, options: Options, *, improving: bool = False) -> None:
        """Start the processes; they roll the policy out, too, if they are improving."""
        self.library, self.options, self.improving = library, options, improving
        self._lock, self._closed = threading.Lock(), False
        self._draw = np.random.default_rng([options.seed, len(library.structures), time.time_ns() % 2**32])
        self._numbers = self._new_numbers()
        self._pool = multiprocessing.get_context("spawn").Pool(options.processes, _one_thread)
        self.error: BaseException | None = None
        for _ in range(3 * options.processes):
            self._submit()

    def _new_numbers(self) -> Iterator[int]:
        known = {*self.library.structures, *self.library.validation, *self.library.failed}
        valid = iter(range(VALIDATION, VALIDATION + VALIDATED))
        for place, number in enumerate(range(self.options.structures)):
            wanted = [number] if place % 6 else [number, *islice(valid, 1)]
            yield from (one for one in wanted if one not in known)

    def _submit(self) -> None:
        if self._closed:
            return
        number, known = None, None
        if not (self.improving and self._draw.random() < 0.5):
            number = next(self._numbers, None)
        if number is None and self.improving and self.library.structures:
            numbers = sorted(self.library.structures)
            success = [self.library.structures[n].success for n in numbers]
            weight = np.array([1.0 if share is None else 1.05 - share for share in success])
            number = int(self._draw.choice(numbers, p=weight / weight.sum()))
            known = self.library.structures[number]
        if number is None:
            return
        folder = self.options.folder if self.improving else None
        asked = number, self.options.families, known, folder
        self._pool.apply_async(case_label, asked, callback=self._done, error_callback=self._failed)

    def _done(self, answer: tuple[int, LabelledStructure | None]) -> None:
        with self._lock:
            self.library.add(*answer)
            self._submit()

    def _failed(self, error: BaseException) -> None:
        self.error = error

    def snapshot(self) -> Library:
        """Return the data so far."""
        with self._lock:
            lib = self.library
            return Library(lib.folder, dict(lib.structures), dict(lib.validation), set(lib.failed))

    def close(self) -> None:
        """End the processes, whatever they are at."""
        self._closed = True
        self._pool.terminate()
        self._pool.join()


def _one_thread() -> None:
    torch.set_num_threads(1)
    os.environ["CUDA_VISIBLE_DEVICES"] = ""


_policies: dict[Path, tuple[float, Any]] = {}


def case_label(
    number: int,
    families: tuple[str, ...] = TRAINED,
    known: LabelledStructure | None = None,
    folder: Path | None = None,
) -> tuple[int, Any]:
    """Label one structure; with more robots, up to four, where those drawn do not suffice."""
    try:
        drawn = generated(number, (known.family,) if known else families)
    except InputError:
        return number, None
    settings, found = LabelSettings(), None
    for robots in range(known.robots if known else drawn.robots, 5):
        policy = None
        if folder is not None and (folder / "run.json").exists():
            policy = load_policy(folder, "cpu", assembly=drawn.assembly)
            policy.of_task(robots, equilibrium=drawn.criterion == "equilibrium")
        # Numbers may come back: other rollouts then.
        seed = number if known is None else int(time.time_ns() % 2**31)
        options = {"seed": seed, "family": drawn.family, "policy": policy, "known": known}
        found = label_states(drawn.assembly, robots, drawn.criterion, settings, **options)
        if found is not None:
            break
    return number, None if found is None else replace(found, name=drawn.name)


def data(options: Options) -> None:
    """Generate structures."""
    end = time.perf_counter() + 60 * options.minutes
    options.folder.mkdir(parents=True, exist_ok=True)
    generator = Generator(Library.load(options.folder), options)
    try:
        while time.perf_counter() < end and generator.error is None:
            time.sleep(max(0.0, min(60.0, end - time.perf_counter())))
            _log(options, _counts(generator.snapshot()))
            generator.snapshot().save()
    finally:
        generator.close()
    generator.library.save()
    if generator.error is not None:
        raise generator.error


def make(options: Options) -> None:
    """Generate and train."""
    begun = time.perf_counter()
    end = begun + 60 * options.minutes
    device = choose_device(options.device)
    options.folder.mkdir(parents=True, exist_ok=True)
    policy = PolicySettings("local", layers=options.layers, channels=options.channels)
    tokens = options.tokens or (131072 if device.type == "cuda" else 4096)
    settings = GeneralSettings(policy, seconds=60 * options.total, tokens=tokens, seed=options.seed)
    training = GeneralTraining(options.folder, settings, device)
    improving = training.progress >= IMPROVE_AFTER
    generator = Generator(Library.load(options.folder), options, improving=improving)
    try:
        saved = time.perf_counter()
        while training.progress < 1.0 and (left := end - RESERVE - time.perf_counter()) > 0:
            if generator.error is not None:
                raise generator.error
            known = generator.snapshot()
            if not known.structures:
                time.sleep(1.0)
                continue
            numbers = training.run(StructureBatches(list(known.structures.values()), device), min(REPORT_EVERY, left))
            valid = (
                training.validate(StructureBatches(list(known.validation.values()), device)) if known.validation else {}
            )
            generator.improving = training.progress >= IMPROVE_AFTER
            training.save({"data": _counts(known), "validation": valid})
            row = {"steps": training.steps, "seconds": training.seconds, "progress": training.progress}
            memory = {"peak_gb": torch.cuda.max_memory_allocated(device) / 1e9} if device.type == "cuda" else {}
            if time.perf_counter() - saved > SAVE_EVERY:
                known.save()
                saved = time.perf_counter()
            _log(options, {**row, "train": numbers, "validation": valid, **_counts(known), **memory})
    finally:
        generator.close()
    generator.library.save()
    print(f"training is {'done' if training.progress >= 1.0 else f'{100 * training.progress:.0f} % done'}", flush=True)


def reinforce(options: Options) -> None:
    """Improve the policy by its own rollouts, on the structures of the data; greedy success before and after."""
    gpus = torch.cuda.device_count() if choose_device(options.device).type == "cuda" else 0
    learners = max(gpus // 2, 1)
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(_reinforce, (learners, options, f"file://{folder}/meet"), nprocs=learners)


def _reinforce(rank: int, learners: int, options: Options, meeting: str) -> None:
    """Improve the policy in one of several processes on half of the GPUs; weights are averaged in between.

    On the other GPUs the network is evaluated for rollouts.

    Args:
        rank: number of the process; the first one reports and writes.
        learners: how many there are, each with its share of the processes that roll out.
        options: of the command.
        meeting: where the processes meet.
    """
    end = time.perf_counter() + 60 * options.minutes
    torch.set_num_threads(1)
    device, host = choose_device(options.device), torch.device("cpu")
    evaluated_on = device
    if device.type == "cuda":
        device, evaluated_on = (torch.device("cuda", one) for one in (rank, torch.cuda.device_count() - 1 - rank))
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=learners)
    group = ProcessGroup.from_torch()
    library = Library.load(options.folder)
    training = continued(options, device)
    settings = GeneralPpoSettings(**({"tokens": options.tokens} if options.tokens else {}))
    known, processes = list(library.structures.values()), max(options.processes // learners, 1)
    learner = GeneralPpo(
        training, known, settings, assembly_of, processes=processes, evaluated_on=evaluated_on, seed=rank
    )

    valid = list(library.validation.values())[rank::learners]

    def note(numbers: dict[str, float], *, validate: bool = False) -> None:
        if validate:
            tried = learner.validate(valid, VALIDATE)
            success, count = summed([sum(tried), len(tried)], group, host)
            numbers |= {"validation": success / max(count, 1), "validated": count}
        if rank == 0:
            training.save({"data": _counts(library), "reinforcement": {**asdict(settings), **numbers}})
            _log(options, {"steps": training.steps, "reinforced": training.reinforced, **numbers})

    note({}, validate=True)
    noted, total, sums = time.perf_counter(), 60 * options.total, defaultdict[str, float](float)
    while decided(left := min(total - training.reinforced, end - RESERVE - time.perf_counter()), group, host) > 0:
        begun, span = time.perf_counter(), decided(min(AVERAGE_EVERY, left), group, host)
        done = training.reinforced / total
        found = learner.run(span, (done, min(done + span / total, 1.0)))
        average_states(training, group)
        training.reinforced += decided(time.perf_counter() - begun, group, host)
        for name, one in zip(SUMS, summed([found[name] for name in SUMS], group, host), strict=True):
            sums[name] += one
        if time.perf_counter() - noted > REPORT_EVERY:
            noted = time.perf_counter()
            note(_means(sums))
            sums.clear()
    note(_means(sums), validate=True)
    learner.close()
    torch.distributed.destroy_process_group()


def _means(sums: dict[str, float]) -> dict[str, float]:
    """Return means a collection and a step, and the counts themselves."""
    count, steps = max(sums["collections"], 1), max(sums["updates"], 1)
    per = {"success": count, "entropy": steps, "divergence": steps}
    return {name: sums[name] / per.get(name, 1) for name in SUMS}


def assembly_of(name: str) -> Assembly:
    """Return a generated structure by its name."""
    return named(name).assembly


def average_states(training: GeneralTraining, group: ProcessGroup) -> None:
    """Give all processes the mean of their weights and of their optimizers, exchanged on the processor."""
    state = training.optimizer.state_dict()
    moved = {name: one for name, one in state.items() if one.is_floating_point()}
    flat = torch.cat([one.detach().flatten().float().cpu() for one in moved.values()])
    torch.distributed.all_reduce(flat)
    pieces = (flat / group.size).split([one.numel() for one in moved.values()])
    means = {name: mean.view_as(moved[name]).to(moved[name].device) for name, mean in zip(moved, pieces, strict=True)}
    training.optimizer.load_state_dict({**state, **means})


def continued(options: Options, device: torch.device) -> GeneralTraining:
    """Return the training of the folder as it is."""
    kept = json.loads((options.folder / "run.json").read_text(encoding="utf-8"))["results"]["general"]
    policy = PolicySettings(**kept.pop("policy"))
    return GeneralTraining(options.folder, GeneralSettings(policy, **kept), device)


def _counts(library: Library) -> dict[str, Any]:
    structures = library.structures.values()
    rolled = [one.success for one in structures if one.success is not None]
    return {
        "structures": len(structures),
        "states": sum(len(one.states) for one in structures),
        "unsolved": len(library.failed),
        "validated": len(library.validation),
        "rolled_out": len(rolled),
        "rollout_success": float(np.mean(rolled)) if rolled else None,
    }


def _log(options: Options, row: dict[str, Any]) -> None:
    line = json.dumps(row)
    print(line, flush=True)
    with (options.folder / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(line + "\n")


def evaluate(options: Options) -> None:
    """Test on structures that are not trained on; cases that are in the file already are left out."""
    policy = cast(LocalAttentionPolicy, load_policy(options.folder, "cpu", assembly=load_structure("arch")))
    device, taken = choose_device(options.device), multiprocessing.get_context("spawn").Value("i")
    inference = Inference(policy.network, policy.settings, options.processes, device)
    _test(options, "evaluation.jsonl", _evaluate_case, (), (_ask_remotely, (inference.connections, taken)))
    inference.close()


def guide(options: Options) -> None:
    """Search with the policy as a guide, and without, like `evaluate`."""
    _test(options, "guides.jsonl", guide_case, (options.folder,), (_one_thread, ()))


def _test(options: Options, file: str, job: Callable[..., Any], about: tuple[Any, ...], begin: tuple[Any, Any]) -> None:
    """Do a job on all cases that are not in a file yet, in processes that begin in some way."""
    end = time.perf_counter() + 60 * options.minutes
    done = {row["case"] for row in _rows(options.folder / file)}

    def chosen(name: str, group: str) -> bool:
        return name.startswith(options.cases) or group in options.cases or not options.cases

    # Large structures come last in the list and take longest.
    names = [name for name, case in reversed(CASES.items()) if name not in done and chosen(name, case.group)]
    with multiprocessing.get_context("spawn").Pool(options.processes, *begin) as pool:
        pending = [pool.apply_async(job, (name, *about)) for name in names]
        while pending and time.perf_counter() < end:
            time.sleep(0.2)
            for one in [one for one in pending if one.ready()]:
                pending.remove(one)
                line = json.dumps(one.get())
                print(line, flush=True)
                with (options.folder / file).open("a", encoding="utf-8") as out:
                    out.write(line + "\n")
        pool.terminate()
    print(f"{len(pending)} cases are left", flush=True)


def _rows(path: Path) -> list[dict[str, Any]]:
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def _ask_remotely(connections: tuple[Connection, ...], taken: Any) -> None:
    _one_thread()
    with taken.get_lock():
        _remote.append(RemotePolicy(connections[taken.value % len(connections)]))
        taken.value += 1


_remote: list[RemotePolicy] = []
"""Of this process, as soon as it tests cases."""


def _evaluate_case(name: str) -> dict[str, Any]:
    return evaluate_case(name, _remote[0])


def card(options: Options) -> None:
    """Summarise the evaluation by group, and record it."""
    write_to(options.out)
    guided: dict[str, dict[str, Any]] = {row["case"]: row for row in _rows(options.folder / "guides.jsonl")}
    rows: list[dict[str, Any]] = [
        {**row, **{name: value for name, value in guided.get(row["case"], {}).items() if name in ("plans", "ratio")}}
        for row in _rows(options.folder / "evaluation.jsonl")
    ]
    run = json.loads((options.folder / "run.json").read_text(encoding="utf-8"))
    about = {"network": run["policy"], "training": run["results"]}
    report("general training", device=options.device if options.device != "auto" else "cpu", **about)
    for group in dict.fromkeys(row["group"] for row in rows):
        mine = [row for row in rows if row["group"] == group]
        tried = [row for row in mine if row.get("states")]
        both = [row for row in mine if row.get("ratio") is not None]
        figures: dict[str, Any] = {
            "cases": len(mine),
            "without": [row["case"] for row in mine if not row.get("states")],
        }
        for name in ("greedy", "sampled"):
            if tried:
                figures[name] = {
                    **spread([row[name] for row in tried]),
                    "mean": float(np.mean([r[name] for r in tried])),
                }
        if both:
            figures["ratio"] = spread([row["ratio"] for row in both])
        figures["failures"] = [row["case"] for row in tried if row["sampled"] < 0.5]
        report("general group", group=group, **figures)
    for row in rows:
        report("general case", **row)


COMMANDS = {
    "make": make,
    "data": data,
    "reinforce": reinforce,
    "evaluate": evaluate,
    "guide": guide,
    "card": card,
}


def main() -> None:
    """Run the command."""
    options = tyro.cli(Options, description=__doc__)
    try:
        COMMANDS[options.what](options)
    except FalseworkError as error:
        raise SystemExit(f"general.py: {error}") from None


if __name__ == "__main__":
    main()
