"""`falsework serve`: replanning and verdicts over HTTP."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from falsework.cli.command import UNSET, JudgingCommand, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.errors import DependencyError, InputError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.service.settings import ServiceSettings


@dataclass(frozen=True, kw_only=True)
class Serve(JudgingCommand):
    """Serve plans and verdicts over HTTP until interrupted.

    STRUCTURE may be the folder of a trained run, whose policy then proposes actions. A page at the printed address
    documents all requests. Only this machine can connect; with --host, others can too, and clients must send the
    token.
    """

    rare: ClassVar[tuple[str, ...]] = ("policy", "token", "workers")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework serve vault --port 8080",
        "FALSEWORK_TOKEN=$(openssl rand -hex 24) falsework serve my-run --host 0.0.0.0",
    )

    outcomes: ClassVar[tuple[str, str]] = ("serving", "failed")

    structure: StructureOptions
    policy: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint=UNSET)] = None
    """Folder of a run for this structure, as `falsework train` wrote it."""
    host: str = "127.0.0.1"
    """Address to listen on; a non-local address needs a token."""
    port: int = 8080
    """Port to listen on; 0 for any that is free."""
    token: Annotated[str | None, arg(metavar="TEXT", help_behavior_hint="(default: FALSEWORK_TOKEN)")] = None
    """Token that clients must send. Other users of this machine can read it here; prefer the environment variable."""
    workers: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: one a core)")] = None
    """Number of planning processes."""

    def run(self, output: Output) -> Exit:
        """Load, listen, serve."""
        settings = self._settings()
        for name in ("fastapi", "uvicorn", "prometheus_client"):
            _check(name)
        from falsework.service.server import run_service

        assembly, run, rules = self._load()
        settings = replace(settings, **rules)

        def started(address: str) -> None:
            policy = None if run is None else str(run)
            output.record({"url": address, "structure": assembly.name, "policy": policy, "criterion": self.criterion})
            output.answer(Exit.DONE)
            output.say(f"{assembly.name} is served at {address}, described at {address}/docs; Ctrl-C ends it")

        run_service(assembly, settings, run=run, started=started)
        output.note(f"falsework: the service of {assembly.name} has ended")
        return Exit.DONE

    def _settings(self) -> ServiceSettings:
        from falsework.service.settings import TOKEN_VARIABLE, ServiceSettings

        token = self.token or os.environ.get(TOKEN_VARIABLE) or None
        settings = ServiceSettings(host=self.host, port=self.port, token=token, criterion=self.criterion)
        return settings if self.workers is None else replace(settings, workers=self.workers)

    def _load(self) -> tuple[Assembly, Path | None, dict[str, Any]]:
        """Return the structure, the run if there is one, and the settings of the service that a run stands for."""
        from falsework.utils.tensors import check_torch

        folder = Path(self.structure.spec)
        if not (folder / "run.json").is_file():
            assembly = self.structure.load()
            if self.policy is not None:
                check_torch()
                from falsework.learn.training.checkpoint import check_structure, read_run, run_folder

                check_structure(self.policy, read_run(run_folder(self.policy)), assembly)
            return assembly, self.policy, {}
        if self.policy is not None:
            raise InputError(f"{folder} is a run already; leave --policy out, or name the structure instead")
        if self.structure.given():
            option = next(iter(self.structure.given()))
            raise InputError(f"{folder} is a run, which says what its structure is; leave --{option} out")
        check_torch()
        from falsework.learn.config.train import TrainSettings, from_dict
        from falsework.learn.training.checkpoint import load_structure_of, read_run

        metadata = read_run(folder)
        trained = from_dict(TrainSettings, metadata["settings"])
        rules = {"robots": trained.robots, "removable_only_if_clear": trained.removable_only_if_clear}
        return load_structure_of(folder, metadata), folder, rules


def _check(name: str) -> None:
    from importlib.util import find_spec

    if find_spec(name) is None:
        raise DependencyError(f"the service needs {name}; pip install 'falsework[service]'")
