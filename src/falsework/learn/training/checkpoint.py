"""Runs on disk: a folder with configuration, weights and a checkpoint to resume from; nothing is pickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.config.train import TrainSettings, from_dict
from falsework.learn.networks import policy as policies
from falsework.learn.networks.custom_policy import PolicyOrClass
from falsework.learn.networks.factory import make_policy
from falsework.search.plans.plan_model import SourceEntry
from falsework.search.plans.plan_source import check_source
from falsework.utils.files.damage import blamed_on
from falsework.utils.files.input_file import read_text
from falsework.utils.files.output_file import write_whole
from falsework.utils.json_text import parse_json
from falsework.utils.models import FileModel, plain, read_model

FORMAT = "falsework.run/2"
CHECKPOINT_FORMAT = "falsework.checkpoint/3"

FILE = "run.json"
WEIGHTS = "weights.safetensors"
CHECKPOINT = Path("checkpoint") / "last.safetensors"
DATA = "data.npz"
SEARCHED = "searched.npz"

GENERAL = "general"
"""Name of the policy for any structure that comes with the package, in place of the folder of a run."""
PRETRAINED = Path(__file__).resolve().parents[1] / "pretrained"


class RunStructure(FileModel, frozen=True):
    """Structure of a run: enough to reload it and to detect another one."""

    name: str
    identity: str
    parts: int
    source: SourceEntry


class RunFile(FileModel, frozen=True):
    """`run.json`."""

    format: str
    structure: RunStructure | None
    """None in a policy for any structure."""
    settings: dict[str, Any]
    policy: Any
    results: Any
    versions: Any


@dataclass(frozen=True, eq=False)
class Run:
    """Trained policy with its structure and settings."""

    folder: Path
    assembly: Assembly
    settings: TrainSettings
    policy: policies.Policy
    """Policy with the trained weights, in evaluation mode."""
    metadata: dict[str, Any]
    """Contents of `run.json`."""


def describe_structure(assembly: Assembly, source: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of a structure in a run: enough to reload it and to detect another one.

    Args:
        source: `built_in` or `path`, the latter relative to the folder of the run, and options of `load_structure`.

    Raises:
        InputError: another source, which `load_run` would refuse.
    """
    values = plain(source)
    about = f"the source of {assembly.name} cannot be recorded: "
    check_source(read_model(SourceEntry, values, about, InputError, "structure.source"), about)
    return {
        "name": assembly.name,
        "identity": assembly.identity,
        "parts": assembly.part_count,
        "source": values,
    }


def write_run(folder: Path, metadata: Mapping[str, Any]) -> None:
    """Write `run.json`.

    Raises:
        InputError: it cannot be written.
    """
    text = json.dumps({"format": FORMAT, **metadata}, indent=1, allow_nan=False) + "\n"
    write_whole(folder / FILE, lambda file: file.write(text.encode()))


def save_run(folder: Path, policy: torch.nn.Module, metadata: Mapping[str, Any]) -> None:
    """Write the weights of a policy and `run.json`, each whole or not at all.

    Args:
        folder: made if it is not there.
        policy: whose weights are written.
        metadata: the other entries of `run.json`.

    Raises:
        InputError: no room, or no permission.
    """
    from safetensors.torch import save

    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: tensor.detach().cpu().clone() for name, tensor in policy.state_dict().items()}
    content = save(weights, {"format": FORMAT})
    write_whole(folder / WEIGHTS, lambda file: file.write(content))
    write_run(folder, metadata)


def run_folder(folder: Path | str) -> Path:
    """Return the folder of a run; that of the package for the name `general`, unless there is a folder of this name."""
    folder = Path(folder)
    return PRETRAINED if str(folder) == GENERAL and not folder.exists() else folder


def read_run(folder: Path) -> dict[str, Any]:
    """Read `run.json`.

    Raises:
        InputError: no such folder, no run in it, damaged, or of another version.
    """
    path = folder / FILE
    if folder == PRETRAINED and not folder.is_dir():
        raise InputError(
            "this installation has no policy for any structure; make one by benchmarks/general.py, and give its folder"
        )
    if folder.is_file():
        raise InputError(f"{folder} is a file; a run is the folder that falsework train writes")
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; falsework train STRUCTURE --out {folder} makes a run")
    try:
        content = parse_json(read_text(path))
    except FileNotFoundError:
        raise InputError(f"{folder} is not a run: it has no {FILE}; falsework train makes one") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); train again") from None
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise InputError(f"{path} has format {found!r}; this version reads {FORMAT!r} only; train again")
    about = f"{path} is not a valid {FORMAT} file: "
    read = read_model(RunFile, content, about, InputError, remedy="; train again")
    if read.structure is not None:
        check_source(read.structure.source, about)
    return content


def load_structure_of(folder: Path, metadata: Mapping[str, Any]) -> Assembly:
    """Load the structure that a run was trained for from its recorded source.

    Raises:
        InputError: it is not there any more, or is another one by now.
    """
    from falsework.assembly import library
    from falsework.assembly.load import load_structure

    structure = metadata["structure"]
    if structure is None:
        raise InputError(f"{folder} is a policy for any structure; name the structure that it is to be used for")
    source = dict(structure["source"])
    spec = source.pop("built_in", None)
    if spec is None:
        path = Path(source.pop("path"))
        spec = str(path if path.is_absolute() else (folder.resolve() / path))
        if not Path(spec).exists():
            raise InputError(
                f"the structure {structure['name']} of the run {folder} is not at {spec} any more; put it back"
            )
    else:
        spec = library.built_in(spec)
    assembly = load_structure(spec, **source)
    check_structure(folder, metadata, assembly)
    return assembly


def check_structure(folder: Path, metadata: Mapping[str, Any], assembly: Assembly) -> None:
    """Compare a structure with that of a run.

    Raises:
        InputError: it is another one.
    """
    trained = metadata["structure"]
    if trained is not None and trained["identity"] != assembly.identity:
        raise InputError(
            f"{folder} was trained for another structure ({trained['name']}, {trained['parts']} parts) than "
            f"{assembly.name} as it is now; train again, or give the structure of the run"
        )


def load_run(
    folder: Path | str,
    device: torch.device | str = "cpu",
    *,
    assembly: Assembly | None = None,
    policy: PolicyOrClass | None = None,
) -> Run:
    """Read a trained policy and the structure that it is for.

    Args:
        folder: folder of the run, or `general` for the policy for any structure that comes with the package.
        device: where the policy is to live.
        assembly: the structure if it is at hand; it must be the one of the run, unless that is for any structure.
        policy: of a run with a policy of your own: its class, or a module that gets the weights, in place of the class
            that would be imported.

    Raises:
        InputError: no run, a damaged one, one of another version or structure, no such device, or a policy whose class
            cannot be imported or has other weights.
    """
    from falsework.utils.tensors import choose_device

    folder = run_folder(folder)
    where = choose_device(device) if isinstance(device, str) else device
    with blamed_on(folder, "train again"):
        metadata = read_run(folder)
        if assembly is None:
            assembly = load_structure_of(folder, metadata)
        else:
            check_structure(folder, metadata, assembly)
        settings = from_dict(TrainSettings, metadata["settings"])
    if policy is not None and not settings.policy.custom:
        raise InputError(f"the policy of {folder} is a {settings.policy.kind} of falsework; leave the policy out")
    trained = make_policy(assembly, settings.policy, where, given=policy)
    if not settings.policy.custom:
        trained.of_task(settings.robots, equilibrium=settings.criterion == "equilibrium")
    with blamed_on(folder, "train again"):
        load_weights(trained, folder / WEIGHTS)
    return Run(folder, assembly, settings, trained.eval(), metadata)


def load_policy(
    folder: Path | str,
    device: torch.device | str = "cpu",
    *,
    assembly: Assembly | None = None,
    policy: PolicyOrClass | None = None,
) -> policies.Policy:
    """Read the trained policy of a run, as `load_run` does, without the rest of it."""
    return load_run(folder, device, assembly=assembly, policy=policy).policy


def load_weights(policy: torch.nn.Module, path: Path) -> None:
    """Read weights into a policy.

    Raises:
        InputError: no such file, damaged, or weights of another network.
    """
    weights, _ = _read(path, "train first: falsework train writes it")
    try:
        policy.load_state_dict(weights)
    except RuntimeError:
        raise InputError(f"{path} holds the weights of another network than its run says; train again") from None


class CheckpointFile:
    """Checkpoint from which an interrupted training continues; a new one replaces the old only when it is complete."""

    def __init__(self, folder: Path) -> None:
        """Use the checkpoint of the run in `folder`."""
        self.path = folder / CHECKPOINT

    def exists(self) -> bool:
        """Return whether there is a checkpoint."""
        return self.path.is_file()

    def save(self, tensors: Mapping[str, torch.Tensor], state: Mapping[str, Any]) -> str:
        """Write a checkpoint; if that fails, the last good one stays.

        Args:
            tensors: of any device.
            state: JSON values.

        Returns:
            Empty, or why it could not be written: training continues, and the next one may have more room.
        """
        from safetensors.torch import save

        self.path.parent.mkdir(parents=True, exist_ok=True)
        # Cloned: safetensors refuses tensors that share memory, as rows of a larger one do.
        flat = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
        header = {"format": CHECKPOINT_FORMAT, "state": json.dumps(state)}
        content = save(flat, header)
        try:
            write_whole(self.path, lambda file: file.write(content))
        except InputError as error:
            return f"{error}; the last checkpoint stays, training continues"
        return ""

    def load(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Read the tensors, on the processor, and the JSON values.

        Raises:
            InputError: there is none, it is damaged, or of another version.
        """
        tensors, header = _read(self.path, "nothing to resume; leave --resume out")
        if header.get("format") != CHECKPOINT_FORMAT:
            raise InputError(
                f"{self.path} has format {header.get('format')!r}; this version reads {CHECKPOINT_FORMAT!r}; train anew"
            )
        try:
            return tensors, json.loads(header["state"])
        except (KeyError, ValueError, RecursionError) as error:
            raise InputError(f"{self.path} is damaged ({type(error).__name__}); leave --resume out") from None


def _read(path: Path, remedy: str) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"there is no file {path}; {remedy}")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{path} is damaged ({' '.join(str(error).split())}); train again") from None
