"""Grammars of the parts of RAPID and URScript that programs use, after the manuals of ABB and Universal Robots."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

Value = Any
"""Number, name, string, list of values, `("pose", values)` or a call: name, values and options."""


def _words(text: str) -> set[str]:
    return set(re.findall(r"\w+", text))


_RAPID_WORDS = _words(
    "ALIAS AND BACKWARD CASE CONNECT CONST DEFAULT DIV DO ELSE ELSEIF ENDFOR ENDFUNC ENDIF ENDMODULE "
    "ENDPROC ENDRECORD ENDTEST ENDTRAP ENDWHILE ERROR EXIT FALSE FOR FROM FUNC GOTO IF INOUT LOCAL MOD "
    "MODULE NOSTEPIN NOT NOVIEW OR PERS PROC RAISE READONLY RECORD RETRY RETURN STEP SYSMODULE TASK TEST "
    "THEN TO TRAP TRUE TRYNEXT UNDO VAR VIEWONLY WHILE WITH XOR"
)
_RAPID_KNOWN = {"v5": "speed", "v200": "speed", "v1000": "speed", "z0": "zone", "fine": "zone", "load0": "loaddata"}
_RAPID_TYPES = {
    "MoveAbsJ": ("jointtarget", "speed", "zone", "tooldata"),
    "MoveL": ("robtarget", "speed", "zone", "tooldata"),
    "SetDO": ("signal", "num"),
    "SetGO": ("signal", "num"),
    "WaitUntil": ("bool",),
    "WaitTime": ("num",),
    "GripLoad": ("loaddata",),
    "SyncMoveOn": ("syncident", "tasks"),
    "SyncMoveOff": ("syncident",),
    "GInput": ("signal",),
    "CalcRobT": ("jointtarget", "tooldata"),
    "RelTool": ("robtarget", "num", "num", "num"),
}
"""Arguments of instructions and functions."""
_RAPID_RESULTS = {"GInput": "num", "CalcRobT": "robtarget", "RelTool": "robtarget"}
_RAPID_OPTIONS = {"MoveAbsJ": {"ID", "T"}, "WaitTime": {"InPos"}, "RelTool": {"Rx", "Ry", "Rz"}}

_UR_WORDS = _words(
    "and break continue def elif else end False for global halt if in inf local mod nan not or pass Pi "
    "return run sec struct thread True while xor"
)
_UR_CALLS: dict[str, tuple[int, set[str]]] = {
    "modbus_add_signal": (6, set()),
    "modbus_set_signal_update_frequency": (2, set()),
    "modbus_get_signal_status": (2, set()),
    "write_port_register": (2, set()),
    "set_standard_digital_out": (2, set()),
    "set_configurable_digital_out": (2, set()),
    "set_tool_digital_out": (2, set()),
    "set_tcp": (1, set()),
    "set_target_payload": (3, set()),
    "movej": (1, {"a", "v"}),
    "servoj": (1, {"t", "lookahead_time", "gain"}),
    "stopj": (1, set()),
    "sleep": (1, set()),
    "sync": (0, set()),
    "zero_ftsensor": (0, set()),
    "force_mode": (5, set()),
    "end_force_mode": (0, set()),
    "get_target_tcp_pose": (0, set()),
    "pose_trans": (2, set()),
}
"""Built-in functions with the number of their arguments and the names of options."""


class Parser:
    """Recursive descent over the tokens of a program."""

    def __init__(self, text: str, comment: str, ends_statement: str) -> None:
        pattern = rf'{comment}[^\n]*|"[^"\n]*"|[A-Za-z]\w*|\d+\.?\d*(?:[Ee][+-]?\d+)?|:=|<>|[<>=!]=|[^\s\w]|\n'
        found = [token for token in re.findall(pattern, text) if not re.match(comment, token)]
        self.tokens = [token for token in found if token != "\n" or ends_statement == "\n"]
        self.ends_statement, self.at = ends_statement, 0

    @property
    def next(self) -> str:
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def skip_lines(self) -> None:
        while self.next == "\n":
            self.at += 1

    def take(self, wanted: str | Callable[[str], Any]) -> str:
        token = self.next
        good = token == wanted if isinstance(wanted, str) else wanted(token)
        assert good, f"{token!r} instead of {wanted!r} in {' '.join(self.tokens[max(0, self.at - 12) : self.at + 4])}"
        self.at += 1
        return token

    def accept(self, *wanted: str) -> bool:
        if self.next not in wanted:
            return False
        self.at += 1
        return True

    def listed(self, close: str, one: Callable[[], Any]) -> list[Any]:
        found = []
        while not self.accept(close):
            if found:
                self.take(",")
            found.append(one())
        return found


class Rapid(Parser):
    """A RAPID module; data in it, and routines that it calls, are declared."""

    def __init__(self, text: str) -> None:
        assert text.isascii()
        assert max(map(len, text.splitlines())) <= 240
        super().__init__(text, "!", ";")
        self.kinds: dict[str, str] = dict(_RAPID_KNOWN)
        self.routines: dict[str, tuple[str, ...]] = {}
        self.called: set[str] = set()
        self.take("MODULE")
        self.module = self.name()
        while self.next in ("CONST", "PERS", "VAR"):
            self.data()
        while self.next == "PROC":
            self.routine()
        self.take("ENDMODULE")
        assert self.next == ""
        known = {*self.routines, *_RAPID_TYPES}
        assert self.called <= known, self.called - known
        names = [name.upper() for name in (self.module, *self.kinds, *self.routines)]
        assert len(set(names)) == len(names)

    def name(self) -> str:
        return self.take(lambda token: re.fullmatch(r"[A-Za-z]\w{0,31}", token) and token.upper() not in _RAPID_WORDS)

    def data(self) -> None:
        storage, kind, name = self.tokens[self.at : self.at + 3]
        self.at += 2
        assert self.name() == name not in self.kinds
        self.kinds[name] = kind
        if storage == "VAR":
            assert kind == "syncident"
            self.take(";")
            return
        assert kind in (("jointtarget",) if storage == "CONST" else ("tooldata", "loaddata", "tasks"))
        if kind == "tasks":
            self.take("{")
            count = int(self.take(str.isdigit))
            self.take("}")
            self.take(":=")
            tasks = self.value()
            assert len(tasks) == count
            assert all(re.fullmatch(r'"T_ROB\d"', task) for (task,) in tasks)
            self.take(";")
            return
        self.take(":=")
        value = self.value()
        {"jointtarget": _check_jointtarget, "tooldata": _check_tooldata, "loaddata": _check_load}[kind](value)
        self.take(";")

    def routine(self) -> None:
        self.take("PROC")
        name = self.name()
        self.take("(")
        parameters = self.listed(")", lambda: (self.take("bool"), self.name())[1])
        outer = dict(self.kinds)
        self.kinds |= dict.fromkeys(parameters, "bool")
        self.block("ENDPROC")
        self.kinds = outer
        assert name not in self.routines
        self.routines[name] = ("bool",) * len(parameters)

    def block(self, *ends: str) -> str:
        while self.next not in ends:
            if self.accept("IF"):
                assert self.kind_of(self.value()) == "bool"
                self.take("THEN")
                if self.block("ELSE", "ENDIF") == "ELSE":
                    self.block("ENDIF")
                continue
            name = self.name()
            self.check_call(name, *self.arguments(lambda: self.next == ";"))
            self.take(";")
        self.at += 1
        return self.tokens[self.at - 1]

    def arguments(self, ended: Callable[[], bool]) -> tuple[list[Value], dict[str, Value]]:
        values: list[Value] = []
        options: dict[str, Value] = {}
        while not ended():
            if self.accept("\\"):
                name = self.name()
                options[name] = self.value() if self.accept(":=") else True
                assert self.next != "\\" or values or options
                if not values:
                    self.take(",")
                continue
            if values:
                self.take(",")
            values.append(self.value())
        return values, options

    def value(self) -> Value:
        left = self.comparison()
        while self.accept("AND", "OR"):
            left = ("bool", left, self.comparison())
        return left

    def comparison(self) -> Value:
        left = self.primary()
        if self.accept("=", "<>", ">=", "<=", "<", ">") or (self.next in "<>" and self.next):
            self.accept("=")
            right = self.primary()
            assert self.kind_of(left) == self.kind_of(right) == "num"
            return ("bool", left, right)
        return left

    def primary(self) -> Value:
        if self.accept("["):
            return self.listed("]", self.value)
        if self.accept("TRUE", "FALSE"):
            return self.tokens[self.at - 1] == "TRUE"
        if self.accept("-"):
            return -self.primary()
        if re.fullmatch(r"\d.*", self.next):
            return float(self.take(lambda _: True))
        if self.next.startswith('"'):
            return self.take(lambda _: True)
        name = self.name()
        if not self.accept("("):
            return name
        given = self.arguments(lambda: self.next == ")")
        self.take(")")
        self.check_call(name, *given)
        return ("call", name)

    def kind_of(self, value: Value) -> str:
        if isinstance(value, bool):
            return "bool"
        if isinstance(value, float):
            return "num"
        if isinstance(value, list):
            _check_jointtarget(value)
            return "jointtarget"
        if isinstance(value, tuple):
            return _RAPID_RESULTS[value[1]] if value[0] == "call" else "bool"
        if re.fullmatch(r"[dg][oi]_\w+", value):
            return "signal"
        return self.kinds[value]

    def check_call(self, name: str, values: list[Value], options: dict[str, Value]) -> None:
        self.called.add(name)
        wanted = _RAPID_TYPES.get(name) or self.routines.get(name)
        if wanted is None:
            assert values == []
            return
        assert tuple(self.kind_of(value) for value in values) == wanted, (name, values)
        assert set(options) <= _RAPID_OPTIONS.get(name, set())
        assert options.get("T", 1.0) >= 0.001


def _check_jointtarget(value: Value) -> None:
    arm, outer = value
    assert len(arm) == len(outer) == 6
    assert all(abs(angle) <= 720 for angle in arm)


def _check_tooldata(value: Value) -> None:
    held, (place, turn), load = value
    assert held is True
    assert len(place) == 3
    assert abs(np.linalg.norm(turn) - 1) < 1e-5
    _check_load(load)


def _check_load(value: Value) -> None:
    mass, center, axes, *moments = value
    assert mass >= 0.001
    assert len(center) == len(moments) == 3
    assert abs(np.linalg.norm(axes) - 1) < 1e-5
    assert min(moments) >= 0


class UrScript(Parser):
    """A URScript program: one function, with others in it, that calls built-in functions."""

    def __init__(self, text: str) -> None:
        assert text.isascii()
        assert not re.search(r"\d[eE][-+\d]", re.sub(r"#.*", "", text))  # numbers have no exponents
        super().__init__(text, "#", "\n")
        self.own: dict[str, int] = {}
        self.take("def")
        self.program = self.name()
        self.take("(")
        self.take(")")
        self.take(":")
        self.block(set())
        self.skip_lines()
        assert self.next == ""

    def name(self) -> str:
        return self.take(lambda token: re.fullmatch(r"[A-Za-z]\w*", token) and token not in _UR_WORDS | {*_UR_CALLS})

    def block(self, names: set[str]) -> None:
        self.take("\n")
        while True:
            self.skip_lines()
            if self.accept("end"):
                return
            if self.accept("def"):
                name = self.name()
                self.take("(")
                parameters = self.listed(")", self.name)
                self.take(":")
                self.own[name] = len(parameters)
                self.block(names | set(parameters))
            elif self.accept("while"):
                self.value(names)
                self.take(":")
                self.block(names)
            else:
                self.accept("return")
                self.value(names)
            self.take("\n")

    def value(self, names: set[str]) -> None:
        self.accept("not")
        self.primary(names)
        while self.accept("and", "or", "==", "!=", ">="):
            self.value(names)

    def primary(self, names: set[str]) -> None:
        self.accept("-")
        if self.accept("("):
            self.value(names)
            self.take(")")
        elif self.next == "p" and self.tokens[self.at + 1] == "[":
            self.at += 2
            assert len(self.listed("]", lambda: self.primary(names))) == 6
        elif self.accept("["):
            assert len(self.listed("]", lambda: self.primary(names))) in (3, 6)
        elif self.accept("True", "False") or re.fullmatch(r"\d.*", self.next) or self.next.startswith('"'):
            self.at += self.tokens[self.at - 1] not in ("True", "False")
        elif self.next in names:
            self.at += 1
        else:
            self.call(names)

    def call(self, names: set[str]) -> None:
        name = self.take(lambda token: token in _UR_CALLS or token in self.own)
        self.take("(")
        values, options = 0, {}
        while not self.accept(")"):
            if values or options:
                self.take(",")
            if self.tokens[self.at + 1] == "=":
                option = self.next
                self.at += 2
                options[option] = self.next
            else:
                assert not options
                values += 1
            self.value(names)
        count, known = _UR_CALLS.get(name, (self.own.get(name), set()))
        assert values == count, name
        assert set(options) == known, name
        if name == "servoj":
            cycles = float(options["t"]) / 0.002
            assert abs(cycles - round(cycles)) < 1e-6
            assert cycles > 0.5
