"""Entry point of `falsework`: command dispatch, one-line error messages and exit codes."""

from __future__ import annotations

import ast
import contextlib
import errno
import importlib
import io
import os
import re
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from shutil import get_terminal_size
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from falsework import __version__
from falsework.cli.arguments import conventions
from falsework.cli.exit_code import Exit
from falsework.cli.output import Output, write_line
from falsework.errors import FalseworkError
from falsework.utils.files.output_file import is_standard_output

if TYPE_CHECKING:
    from falsework.cli.command import Command

COMMANDS = {
    "structures": "Structures",
    "doctor": "Doctor",
    "export": "Export",
    "stability": "CheckStability",
    "margins": "FindMargins",
    "plan": "MakePlan",
    "check": "CheckPlan",
    "graph": "MakeGraph",
    "serve": "Serve",
    "train": "Train",
    "evaluate": "Evaluate",
    "replan": "MakeReplan",
    "view": "View",
    "picture": "MakePicture",
    "cell new": "new_cell.NewCell",
    "robots plan": "robots_plan.PlanRobots",
    "robots check": "CheckRobots",
    "robots export": "robots_export.ExportRobots",
}
"""Class of each subcommand, in the module of this package that is named like its first word unless another is given."""
_GROUPS = {
    "cell": """Write cells, which `falsework doctor --cell` checks.

A cell has the robots, their bases and grippers, and the obstacles around them.

Built-in cells: bottle-12, dome-37, dome-72, vault-62-a, vault-62-b.
Built-in arms: crb15000-5/0.95, irb2600-12/1.65, ur10e.""",
    "robots": "Plan motions of robot arms, check them, and export them to controllers.",
}
"""Descriptions of commands of two words."""

_ABOUT = """Plan assembly sequences for rigid-block structures, with robots as temporary supports.

Example:
  falsework plan vault --robots 2 --out plan.json
  falsework check plan.json

Exit codes: 0 done, 1 the answer is no, 2 wrong input,
3 yes on conditions that the input sets itself, 4 out of memory."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        Exit code, see `Exit`; nothing is raised, whatever happens.
    """
    # Threads of OpenBLAS only get in the way of the solvers' own; where they cannot start, it interrupts the program.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    output = Output(machine="--json" in arguments, command=_named(arguments))
    try:
        with warnings.catch_warnings():
            _warn_in_one_line(lambda text: output.note(text))
            command = _parse(arguments)
            if command is None:
                return Exit.DONE
            out: Path | None = getattr(command, "out", None)
            aside = is_standard_output(out or "-")
            output = Output(machine=command.json, aside=aside, command=output.command, outcomes=command.outcomes)
            output.replaced = out if out is not None and out.is_file() else None
            code = command.run(output)
            output.answer(code)
            sys.stdout.flush()
            return code
    except _UsageError as error:
        return _fail(str(error), Exit.WRONG_INPUT, output)
    except KeyboardInterrupt:
        return _fail("interrupted", Exit.INTERRUPTED, output)
    except BrokenPipeError:  # the reader, such as `head`, has gone: Python must not write to it at exit
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.DONE
    except Exception as error:  # the last handler: one line and an exit code
        if debug:
            for line in traceback.format_exc().splitlines():
                write_line(line, sys.stderr)
        return _fail(_explain(error), Exit.NO_MEMORY if _lacks_memory(error) else Exit.WRONG_INPUT, output)


_HELP, _HELP_ALL = ("-h", "--help"), "--help-all"
_Shown = Literal["everything", "without structure", "brief"]
"""Options that are shown: all, for parsing; all but those of the structure; or those that are needed often."""
_SHELLS = ("bash", "zsh", "tcsh", "fish")
_COMPLETION = "--tyro-write-completion"
_OPTION_INDENT, _HELP_INDENT = 5, 9
"""Columns by which tyro indents options and their help texts inside the box of a message."""


def _without_values(found: re.Match[str]) -> str:
    return re.sub(r", (?!-\D)[^,]*", "", found[0])


def _missing(found: re.Match[str]) -> str:
    return f"{found[1].upper()} is missing, or an option does not exist"


_PLAIN_WORDS: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"error parsing (\S+): no type matching FLOAT .* from \[(.*?)\].*?(?=;|$)", r"\1 is \2; give a number"),
    (r"error parsing (\S+): no type matching INT .* from \[(.*?)\].*?(?=;|$)", r"\1 is \2; give a whole number"),
    (r"error parsing (\S+): could not convert string to float: ('.*?')", r"\1 is \2; give a number"),
    (r"error parsing (\S+): invalid literal for int\(\) with base 10: ('.*?')", r"\1 is \2; give a whole number"),
    (r"missing value for argument '(--\S+)'\. Expected 1 values", r"\1 has no value; give one"),
    (r"error parsing (\S+): (?=is empty)", r"\1 "),
    (r"unrecognized options: (?=[^-])", "too many values: "),
    (r"unrecognized options: -[^;]*", _without_values),
    (r"missing value for argument '(\w+)\S*'\. Expected 1 values", _missing),
)
"""Messages of tyro that name types of Python, and what they say to a user."""
_CHOICES = re.compile(r"invalid choice ('.*?') for argument '(\S+)'\. Expected one of \((.*?)\)")
"""Message of tyro for a value that is none of the choices, which it gives in any order and with `None` among them."""


class _UsageError(Exception):
    """Options that do not make a command."""


def _named(arguments: list[str]) -> str | None:
    """Return the subcommand that arguments begin with."""
    return next((name for name in (" ".join(arguments[:2]), *arguments[:1]) if name in COMMANDS), None)


def _parse(arguments: list[str]) -> Command | None:
    """Fill in the subcommand's fields, or print help or version and return None."""
    if arguments == ["--version"]:
        sys.stdout.write(f"falsework {__version__}\n")
        return None
    if arguments in (["--help"], ["-h"]):
        sys.stdout.write(_overview())
        return None
    if arguments[:1] == [_COMPLETION] and (len(arguments) != 3 or arguments[1] not in _SHELLS):
        raise _UsageError(f"{_COMPLETION} takes a shell ({', '.join(_SHELLS)}) and the file to write")
    import tyro

    named = _named(arguments)
    if named is not None:
        kind: Any = command_class(named)
        rest = arguments[len(named.split()) :]
        shown: _Shown = "everything" if {*_HELP, _HELP_ALL}.isdisjoint(rest) else "brief"
        _prepare(kind, "without structure" if _HELP_ALL in rest else shown)
        rest = ["--help" if word == _HELP_ALL else word for word in rest]
        about, program = _help_text(kind), f"falsework {named}"
    elif {*_HELP, _HELP_ALL, _COMPLETION}.isdisjoint(arguments[:2]):
        raise _UsageError(_no_subcommand(arguments))
    else:
        group = [name for name in COMMANDS if " " in name and name.split()[:1] == arguments[:1]]
        classes = [
            Annotated[kind, tyro.conf.subcommand(name.split()[-1] if group else name, description=_first_line(name))]
            for name, kind in ((name, command_class(name)) for name in group or COMMANDS)
        ]
        program, rest = ("falsework", arguments) if not group else (f"falsework {arguments[0]}", arguments[1:])
        program = f"falsework {group[0]}" if len(group) == 1 else program
        about = _GROUPS.get(arguments[0], _ABOUT)
        kind = Union[tuple(classes)]  # noqa: UP007  # type: ignore[valid-type]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, prog=program, description=about, args=rest, **conventions())
    except SystemExit as exit_request:
        if exit_request.code in (None, 0):
            if named is not None and not {*_HELP}.isdisjoint(rest):
                sys.stdout.write(_more_help(kind, named, arguments))
            return None
        said = _one_line(complaint.getvalue()) or f"wrong options; see {program} --help"
        if named and any(getattr(one, "structure", "") is None for one in (kind, *get_type_hints(kind).values())):
            said = re.sub("too many values: [^;]*", r"\g<0>; name a structure with --structure", said)
        raise _UsageError(said) from None


def _more_help(kind: Any, name: str, arguments: list[str]) -> str:
    """Return the end of a help text: where the options are described that it leaves out."""
    from falsework.cli.command import LoadOptions

    if name == "structures":
        return f"Options of all commands that take a structure:\n\n{_structure_options()}"
    types = [kind, *get_type_hints(kind).values()]
    taken = any(isinstance(one, type) and issubclass(one, LoadOptions) for one in types)
    lines = ["Options of the structure, such as --unit and --friction: falsework structures --help"] * taken
    lines += [f"Options that are needed seldom: falsework {name} {_HELP_ALL}"] * (_HELP_ALL not in arguments)
    return "".join(f"{line}\n" for line in lines)


def _structure_options() -> str:
    """Return the help text of the options of a structure."""
    import tyro

    from falsework.cli.command import LoadOptions

    _prepare(LoadOptions, "everything")
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        tyro.cli(LoadOptions, prog="falsework", args=["--help"], **conventions())
    lines = [line.strip("│").rstrip() for line in text.getvalue().splitlines()]
    first = next(number for number, line in enumerate(lines) if re.match(r" *--[a-z]", line))
    return "\n".join(line for line in lines[first:] if line and not line.startswith("╰")) + "\n"


def _no_subcommand(arguments: list[str]) -> str:
    if not arguments or arguments[0].startswith("-"):
        before = f" before {arguments[0]}" if arguments else ""
        return f"give a subcommand{before}: {', '.join(COMMANDS)}; for help, run falsework --help"
    from difflib import get_close_matches

    near = get_close_matches(" ".join(arguments[:2]), COMMANDS, 1, 0.8)
    near = near or [name for name in COMMANDS if name.startswith(f"{arguments[0]} ")]
    near = near or get_close_matches(arguments[0], COMMANDS, 1)
    meant = f"perhaps you meant: {', '.join(near)}; " if near else ""
    words = [word for word in arguments[: 2 if arguments[0] in _GROUPS else 1] if not word.startswith("-")]
    return f"there is no subcommand {' '.join(words)!r}; {meant}for all, run falsework --help"


def _prepare(kind: Any, shown: _Shown) -> None:
    """Prepare the fields of a command for tyro: what every command has comes last, and help texts leave options out.

    For Python before 3.14 `X | None` becomes `Optional[X]`: to check a default against the former, tyro imports
    typeguard and with it asyncio, for a fifth of a second.
    """
    import tyro

    from falsework.cli.command import LoadOptions

    hints = get_type_hints(kind, include_extras=True)
    hidden: set[str] = set()
    if shown == "brief":
        hidden |= {name for base in kind.__mro__ for name in vars(base).get("rare", ())}
    if shown != "everything" and issubclass(kind, LoadOptions):
        hidden |= set(LoadOptions.__dataclass_fields__)
    for name, hint in hints.items():
        inner, notes = (hint.__origin__, hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())
        if isinstance(inner, UnionType):
            inner = Union[get_args(inner)]  # noqa: UP007  # type: ignore[valid-type]
        elif is_dataclass(inner):
            _prepare(inner, shown)
        notes = [note for note in notes if note is not tyro.conf.Suppress]
        notes += [tyro.conf.Suppress] * (name in hidden)
        hints[name] = Annotated[(inner, *notes)] if notes else inner
    kind.__annotations__ = hints
    shared = [name for base in kind.__mro__[1:] for name in vars(base).get("__annotations__", ())]
    fields_by_name = kind.__dataclass_fields__
    for name in dict.fromkeys(name for name in shared if name in fields_by_name):
        fields_by_name[name] = fields_by_name.pop(name)


def command_class(name: str) -> type[Command]:
    """Return the class of a subcommand, whose module is imported here."""
    module, kind = _place(name)
    return getattr(importlib.import_module(f"falsework.cli.{module}"), kind)


def _place(name: str) -> tuple[str, str]:
    """Return the module and the class of a subcommand."""
    module, _, kind = COMMANDS[name].rpartition(".")
    return module or name.split()[0], kind


@cache
def _first_lines(module: str) -> dict[str, str]:
    """Return the first docstring line of the classes of a module, without importing the module."""
    source = Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8")
    classes = [found for found in ast.parse(source).body if isinstance(found, ast.ClassDef)]
    return {found.name: (ast.get_docstring(found) or "").partition("\n")[0] for found in classes}


def _first_line(name: str) -> str:
    module, kind = _place(name)
    return _first_lines(module).get(kind, "")


def _overview() -> str:
    """Return the help text of the whole program; the command line's parser would take a second to import for it."""
    indent = max(map(len, COMMANDS)) + 4
    lines = [
        "usage: falsework [-h] [--version] SUBCOMMAND ...",
        "",
        _ABOUT,
        "",
        f"{_COMPLETION} SHELL FILE writes completions for {', '.join(_SHELLS)}.",
        "",
        "Subcommands, each with its own --help, and --help-all with rare options:",
    ]
    for name in COMMANDS:
        first = f"  {name}".ljust(indent)
        width = max(get_terminal_size().columns, indent + 20)
        lines += textwrap.wrap(_first_line(name), width, initial_indent=first, subsequent_indent=" " * indent)
    return "\n".join(lines) + "\n"


def _help_text(kind: type[Command]) -> str:
    text = "\n".join(line.strip() for line in (kind.__doc__ or "").strip().splitlines())
    heading = "Examples:" if len(kind.examples) > 1 else "Example:"
    return "\n".join([text, "", heading, *(f"  {line}" for line in kind.examples)])


def _one_line(box: str) -> str:
    """Turn the boxed error message of tyro into one line: options without their help texts, values in plain words."""
    sections: list[list[str]] = [[]]
    for line in box.splitlines()[1:-1]:
        text = line.strip("│| \t")
        if text and not text.strip("─-"):
            sections.append([])
        elif text and not line.strip("│").startswith(" " * _HELP_INDENT):
            option = line.strip("│").startswith(" " * _OPTION_INDENT) and len(sections[-1]) > 1
            sections[-1].append(f", {text}" if option else f" {text}")
    texts = ["".join(section).strip().rstrip(".") for section in sections if section[:1] != [" Argument helptext:"]]
    line = "; ".join(text[0].lower() + text[1:] for text in texts if text).replace("for full helptext,", "for help,")
    for pattern, words in _PLAIN_WORDS:
        line = re.sub(pattern, words, line)
    return _CHOICES.sub(_choices, line)


def _choices(found: re.Match[str]) -> str:
    value, option, listed = found.groups()
    choices = sorted(set(re.findall(r"'(.*?)'", listed)) - {"None"})
    return f"{option} is {value}; choose {', '.join(choices)}"


def _explain(error: Exception) -> str:
    """Return one line for an error: known errors say what to do, others get their kind and a way to learn more."""
    text = " ".join(str(error).split())
    if _lacks_memory(error):
        return "out of memory; try a smaller structure or search width"
    if isinstance(error, FalseworkError):
        return text
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename and error.strerror else text
    return f"unexpected {type(error).__name__}: {text}; this is a defect, --debug shows where"


def _lacks_memory(error: BaseException | None) -> bool:
    """Return whether an error, or one that led to it, is for want of memory, as that to load a library is."""
    if error is None:
        return False
    words = ("failed to map segment", "cannot allocate memory")
    return (
        isinstance(error, MemoryError)
        or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        or (isinstance(error, (OSError, ImportError)) and any(word in str(error).lower() for word in words))
        or _lacks_memory(error.__cause__ or (None if error.__suppress_context__ else error.__context__))
    )


def _fail(text: str, code: Exit, output: Output) -> Exit:
    write_line(f"falsework: {text}", sys.stderr)
    # A reader that has gone gets no answer.
    with contextlib.suppress(OSError):
        output.answer(code, text)
    return code


def _warn_in_one_line(note: Callable[[str], None]) -> None:
    """Show warnings like errors: one line, without the place in the code."""

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        if not issubclass(category, UserWarning):  # warnings of packages for programmers are not for users
            return
        note(f"falsework: warning: {' '.join(str(message).split())}")

    warnings.simplefilter("default")
    warnings.showwarning = show
