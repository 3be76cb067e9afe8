"""Public benchmark of assembly planning.

    python -m bench structures                        # structures, and which of them are here
    python -m bench questions --only 'plan/*/dog-35/*'
    python -m bench run falsework --only 'plan/*/arch*' --out mine.jsonl
    python -m bench check mine.jsonl                  # judge a submission, line by line
    python -m bench check bench/results/falsework.jsonl --only plan/contact/dome-37/2
    python -m bench table                             # fill the tables of docs/benchmark.md

Run it in a checkout of the repository, with falsework installed. Structures of other people are found below the folder
of `--data`, by default FALSEWORK_DATA; questions about those that are not there are skipped with the reason. See
docs/benchmark.md. Exit codes: 0 all is well, 1 an answer is refuted or none could be checked, 2 wrong input.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from fnmatch import fnmatchcase
from itertools import groupby
from pathlib import Path
from typing import Any

import tyro
from tyro.conf import Positional

from bench import bricks, table
from bench.judge import judge
from bench.methods import METHODS, Method, line_of, policy_of, timed
from bench.questions import STATES, Question, questions, state_sets
from bench.records import line_of as judged_line
from bench.records import read_record, record_path, still_true, write_record
from bench.states import draw, row_name, rows, write_states
from bench.structures import MANIFEST, NotHereError, Structure, data_root, manifest, pinned, structures
from bench.submission import FORMAT, Submission, read_submission
from benchmarks.record import commit, processor, versions
from falsework import __version__
from falsework.assembly.model import Assembly
from falsework.errors import FalseworkError, InputError
from falsework.utils.files.output_file import check_writable

DONE, NO, WRONG = 0, 1, 2


@dataclass(frozen=True)
class ListStructures:
    """List the structures, their sources and licences, and why those that are not here are skipped."""

    data: Path | None = None
    """Folder of the structures of other people."""
    only: str = "*"
    """Pattern of names, as of a shell."""
    sources: bool = False
    """Print the commands that fetch the missing ones from their sources, one for each repository."""
    pin: bool = False
    """Write hashes and numbers of parts of those that have none into the manifest."""

    def run(self) -> int:
        """Load each, and say what came of it."""
        root = data_root(self.data)
        if self.pin:
            say(f"{pinned(MANIFEST, root)} structures pinned")
            return DONE
        if self.sources:
            return self._sources(root)
        for structure in structures(root).values():
            if matches(structure.name, self.only):
                origin = "generated" if structure.generated else f"{structure.licence}, {structure.holder}"
                try:
                    structure.load(root)
                    what = "here"
                except NotHereError as error:
                    what = f"skipped: {error}"
                say(f"{structure.split:16} {structure.name}: {structure.parts} parts, {origin}; {what}")
        return DONE

    def _sources(self, root: Path) -> int:
        missing: dict[str, Structure] = {}
        for structure in manifest().values():
            if structure.path and structure.place(root) is None:
                missing.setdefault(structure.repository, structure)
        for repository, structure in missing.items():
            place = root / repository.rpartition("/")[2]
            say(f"git clone https://{repository} {place} && git -C {place} checkout {structure.commit}")
        return DONE


@dataclass(frozen=True)
class Selection:
    """Questions, and where their structures are."""

    only: str = "*"
    """Pattern of questions, as of a shell, such as `plan/*/dog-35/2`."""
    splits: tuple[str, ...] = ()
    """Splits of their structures; all if none is given."""
    data: Path | None = None
    """Folder of the structures of other people; by default FALSEWORK_DATA."""

    @property
    def root(self) -> Path:
        """Folder of data."""
        return data_root(self.data)

    def questions(self) -> list[Question]:
        """Return the questions.

        Raises:
            InputError: there is none, or no such split.
        """
        found = questions(self.root, self.only, self.splits)
        if not found:
            raise InputError(f"no question matches {self.only!r}; `python -m bench questions` lists them")
        return found


@dataclass(frozen=True)
class ListQuestions(Selection):
    """Print questions as JSON lines: name, hash of the structure, robots, state to begin in."""

    def run(self) -> int:
        """Print them."""
        for question in self.questions():
            say(json.dumps(question.to_dict()))
        return DONE


@dataclass(frozen=True, kw_only=True)
class Run(Selection):
    """Answer questions by a method that comes with the benchmark, and append the answers to a submission."""

    method: Positional[str]
    """`falsework`, `depth-first`, `uniform`, or `policy`."""
    out: Path
    """Submission; questions that it answers are not asked again."""
    limit: float = 60.0
    """Seconds for each question."""
    minutes: float | None = None
    """Minutes of processor time after which no more questions are asked."""
    policy: Path | None = None
    """With `policy`: folder that `falsework train` wrote."""
    settings: str = ""
    """What the reader should know of the method, such as how a policy was trained."""

    def run(self) -> int:
        """Answer, structure by structure."""
        method, begun = self._method(), time.process_time()
        found = [question for question in self.questions() if question.task in method.tasks]
        if not found:
            raise InputError(f"{self.method} answers {', '.join(method.tasks)} only; choose such questions with --only")
        known = set(self._begin())
        todo = [question for question in found if question.name not in known]
        with self.out.open("a", encoding="utf-8") as file:
            for question, assembly in loaded(todo, self.root):
                if self.minutes is not None and time.process_time() - begun > 60 * self.minutes:
                    say(f"{self.minutes:g} minutes are over; the same command goes on")
                    break
                answer, seconds = timed(method, question, assembly, self.limit)
                file.write(json.dumps(line_of(question, assembly, answer, seconds)) + "\n")
                file.flush()
                what = answer.reason if answer.steps is None else f"{len(answer.steps)} steps"
                say(f"{question.name}: {what}, {seconds:.2f} s")
        return DONE

    def _method(self) -> Method:
        if (self.method == "policy") != (self.policy is not None):
            raise InputError("the method policy, and only this one, needs the folder of a run; give --policy RUN")
        if self.policy is not None:
            return policy_of(self.policy)
        if self.method not in METHODS:
            raise InputError(f"there is no method {self.method!r}; choose {', '.join([*METHODS, 'policy'])}")
        return METHODS[self.method]

    def _begin(self) -> list[str]:
        """Return the questions that are answered; begin a new submission if there is none."""
        if self.out.exists() and self.out.stat().st_size:
            answered = read_submission(self.out, self.root)
            refuse_faults(self.out, answered)
            return [answer.question.name for answer in answered.answers]
        words = f"limit {self.limit:g} s a question; seconds are of processor time"
        about = {
            "format": FORMAT,
            "method": f"falsework {self.method}" if self.method == "policy" else self.method,
            "version": __version__,
            "commit": commit(),
            "date": date.today().isoformat(),
            "device": processor(),
            "settings": f"{self.settings}; {words}" if self.settings else words,
        }
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.write_text(json.dumps(about) + "\n", encoding="utf-8")
        return []


@dataclass(frozen=True, kw_only=True)
class Check(Selection):
    """Judge a submission: every state of every answer anew. Nothing in it is trusted."""

    submission: Positional[Path]
    """File of JSON lines."""
    line: int | None = None
    """Judge only the answer in this line of the file."""
    new: bool = False
    """Judge only answers that have no judgement on record."""
    record: bool = False
    """Keep the judgements in a file beside the submission, from which the table is made; those of
    answers that have not changed stay."""

    def run(self) -> int:
        """Judge, and compare with the judgements on record."""
        found = read_submission(self.submission, self.root)
        for fault in found.faults:
            say(f"{self.submission}, line {fault.line}: {fault.what}", error=True)
        answers = {
            answer.question.name: answer
            for answer in found.answers
            if matches(answer.question.name, self.only)
            and (not self.splits or answer.question.structure.split in self.splits)
            and self.line in (None, answer.line)
        }
        if not answers and not found.faults:
            raise InputError(f"{self.submission} answers no question that was asked for; leave out --only and --line")
        path = record_path(self.submission)
        if self.record:
            check_writable(path)
        known = still_true(read_record(path), found) if path.exists() else {}
        if self.new:
            answers = {name: answer for name, answer in answers.items() if name not in known}
            if not answers and not found.faults:
                say(f"{path} has a judgement of each answer")
                return DONE
        judged, refuted = {}, 0
        for question, assembly in loaded([answer.question for answer in answers.values()], self.root):
            answer = answers[question.name]
            judgement = judge(answer, assembly)
            refuted += judgement.outcome == "refuted"
            judged[question.name] = judged_line(answer, judgement)
            what = f"{judgement.steps} steps, {judgement.robots} robots, reserve {judgement.reserve:g}"
            say(f"{judgement.outcome:8} {question.name}: {what if judgement.solved else judgement.reason}")
            said = known.get(question.name)
            if said is not None and said["outcome"] != judgement.outcome:
                say(f"{path} has another judgement of {question.name}", error=True)
                refuted += 1
        if self.record:
            about = {
                **found.about,
                "submission": self.submission.name,
                "faults": len(found.faults),
                "checked": {"commit": commit(), "date": date.today().isoformat(), "versions": versions()},
            }
            write_record(path, about, {**known, **judged})
        solved = sum(line["outcome"] == "solved" for line in judged.values())
        say(
            f"{solved} solved of {len(judged)} judged, {len(answers) - len(judged)} skipped, {len(found.faults)} faults"
        )
        return WRONG if found.faults else NO if refuted or not judged else DONE


@dataclass(frozen=True)
class DrawStates:
    """Draw the states of rows that have none yet."""

    data: Path | None = None
    """Folder of the structures of other people."""
    only: str = "*"
    """Pattern of rows, such as `replan/contact/dog-35/2`."""

    def run(self) -> int:
        """Draw and write them, row by row."""
        root, sets = data_root(self.data), dict(state_sets())
        for task, structure, robots in rows(dict(manifest())):
            name = row_name(task, structure, robots)
            if name in sets or not matches(name, self.only):
                continue
            begun = time.process_time()
            try:
                sets[name] = draw(task, structure, structure.load(root), robots)
            except NotHereError as error:
                say(f"skipped {error}")
                continue
            write_states(STATES, sets)
            say(f"{name}: {len(sets[name])} states, {time.process_time() - begun:.1f} s")
        return DONE


@dataclass(frozen=True)
class ReadBricks:
    """Write the structures of a parquet file of StableText2Brick as texts of bricks, below the folder of data."""

    file: Positional[Path]
    """Such as `test-00000-of-00001.parquet`."""
    data: Path | None = None
    """Folder of the structures of other people."""

    def run(self) -> int:
        """Write them."""
        root = data_root(self.data)
        say(f"{bricks.unpack(self.file, root)} structures in {root / bricks.BRICKS}")
        return DONE


@dataclass(frozen=True)
class FillTable:
    """Fill the tables of docs/benchmark.md from the judgements on record."""

    def run(self) -> int:
        """Write the page."""
        say(f"{table.PAGE}: {'filled' if table.fill() else 'is up to date'}")
        return DONE


COMMANDS: dict[str, Any] = {
    "structures": ListStructures,
    "questions": ListQuestions,
    "run": Run,
    "check": Check,
    "states": DrawStates,
    "bricks": ReadBricks,
    "table": FillTable,
}


def say(text: str, *, error: bool = False) -> None:
    """Print a line."""
    print(text, file=sys.stderr if error else sys.stdout, flush=True)


def matches(name: str, only: str) -> bool:
    """Return whether a name matches a pattern of the shell."""
    return fnmatchcase(name, only)


def loaded(found: Sequence[Question], root: Path) -> Iterator[tuple[Question, Assembly]]:
    """Yield questions with their structures, each of which is loaded once; say why others are skipped."""
    by_structure = sorted(found, key=lambda question: (question.structure.parts, question.structure.name))
    for structure, group in groupby(by_structure, key=lambda question: question.structure):
        some = list(group)
        try:
            assembly = structure.load(root)
        except NotHereError as error:
            say(f"skipped  {len(some)} question{'s' * (len(some) > 1)}: {error}")
            continue
        yield from ((question, assembly) for question in some)


def refuse_faults(path: Path, found: Submission) -> None:
    """Raise if a submission that is to be continued has a faulty line.

    Raises:
        InputError: it has; the message names the first.
    """
    if found.faults:
        fault = found.faults[0]
        raise InputError(f"{path}, line {fault.line}: {fault.what}; remove the line to go on")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code."""
    command = tyro.extras.subcommand_cli_from_dict(COMMANDS, description=__doc__, args=arguments)
    try:
        return command.run()
    except FalseworkError as error:
        say(f"bench: {error}", error=True)
        return WRONG
    except OSError as error:
        say(f"bench: {error.filename or 'a file'}: {error.strerror or error}; name another place", error=True)
        return WRONG
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
