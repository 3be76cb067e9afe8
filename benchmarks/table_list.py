"""Tables that `benchmarks/tables.py` generates: one for each question of RESULTS.md, from its records and columns."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean
from typing import Any

from table_model import Record, Runs, Table, number


def quiet(record: Record) -> bool:
    """Return whether the machine was idle before the run, as far as is known; other runs count, but are not timed."""
    return record.get("load_before", 0) <= 2


def needs_robots(record: Record) -> bool:
    """Return whether more than one robot is needed under some rules, or was not shown to suffice."""
    return any(record[rules]["robots"] != 1 for rules in ("once", "again") if rules in record)


def over_draws(key: str, form: str = "") -> Callable[[Runs], str]:
    """Return a column with the mean and the range of a figure over all test draws of all runs.

    Args:
        key: name of the figure of a draw.
        form: of the numbers.
    """

    def write(runs: Runs) -> str:
        values = [draw[key] for run in runs for draw in run["draws"]]
        mean, low, high = (number(value, form) for value in (fmean(values), min(values), max(values)))
        return mean if low == high else f"{mean} ({low} to {high})"

    return write


def of_paper_data(record: Record) -> bool:
    """Return whether a run learned by reinforcement from the states of one search, without changes of the preset."""
    if record["data"] != "width64" or record.get("clear"):
        return False
    return record["label"] == "explored" or (record["label"], record.get("rollouts")) == ("reinforcement", 8192)


def of_wide_data(record: Record) -> bool:
    """Return whether a run learned by the default preset from many searches, and was tested on all or several draws."""
    if (record["data"], record["criterion"]) != ("wide", "contact") or "NVIDIA" not in record["device"]:
        return False
    if record["benchmark"] == "learning draws":
        return record["phases"][0] == "imitation" and record["label"] in ("", "bottle", "one-recipe", "one-recipe-2")
    return record["evaluated"] == "all states"


def of_policy(policy: bool, deadline: float, value: Callable[[Record], Any]) -> Callable[[Runs], str]:
    """Return a column with a figure of replanning within a deadline, with a policy or without."""

    def write(runs: Runs) -> str:
        found = [value(run) for run in runs if (run["policy"], run["deadline"]) == (policy, deadline)]
        return number(found[-1]) if found else ""

    return write


def fewest(rules: str) -> Callable[[Runs], str]:
    """Return a column with the fewest robots with which a plan was found under some rules, and why not with fewer."""

    def write(runs: Runs) -> str:
        run = next((run for run in runs if rules in run), None)
        if run is None:
            return ""
        answer = run[rules]
        robots = "none found" if answer["robots"] is None else str(answer["robots"])
        ended = {"deadline": "deadline", "search": "searches ended"}.get(answer.get("ended", ""), "")
        return f"{robots} ({ended})" if ended else robots

    return write


def counted(path: str) -> Callable[[Runs], str]:
    """Return a column with the runs in which a build by discrete elements stands to its end, of those with a plan."""

    def write(runs: Runs) -> str:
        planned = [run for run in runs if run["states"]]
        whole = sum(run[path]["stands"] == run["states"] for run in planned)
        return f"{whole} of {len(planned)}"

    return write


def standing(key: str) -> Callable[[Runs], str]:
    """Return a column with the plans of which none of some replays falls, of those with a reserve."""

    def write(runs: Runs) -> str:
        found = [run[key] for run in runs if run["accepted"]]
        return f"{found.count(0)} of {len(found)}"

    return write


def total(path: str) -> Callable[[Runs], str]:
    """Return a column with the sum of a figure over all runs."""
    return lambda runs: number(sum(int(run[path]) for run in runs))


def planned(runs: Runs) -> str:
    """Write the searches that found a plan."""
    return f"{sum(run['ended'] == 'found' for run in runs)} of {len(runs)}"


STRUCTURE = (("structure", "{structure}"),)
STRUCTURE_AND_ROBOTS = (("structure", "{structure}"), ("robots", "{robots}"))
PAIRS = (
    ("success, %", "{test.success:%}"),
    ("of a second draw", "{second.success:%}"),
    ("checked", "{test.checked:%}"),
    ("second, checked", "{second.checked:%}"),
)

RULES_KEY = (("switched off", "{without}"), ("criterion", "{criterion}"))
RULES = (
    ("takes effect in runs", "{acts} of {runs}"),
    ("solved with it, %", "{solved.with:%}"),
    ("without, %", "{solved.without:%}"),
    ("runs solved only with it", "{only_with}"),
    ("only without", "{only_without}"),
    ("without the reserve, with it, %", "{without_reserve.with:%}"),
    ("without, %", "{without_reserve.without:%}"),
    ("verdicts, ratio", "{verdicts}"),
    ("replayed steps, ratio", "{replayed}"),
    ("CPU time, ratio", "{processor_seconds}"),
    ("CPU time of all, ratio", "{all_processor_seconds.without/all_processor_seconds.with}"),
)
"""Columns with which `luck.py` prints what rules of the search do."""


TABLES = {
    "plans": Table(
        "contact",
        STRUCTURE,
        (
            ("plan with proofs and replay, s", "{seconds}"),
            ("verdicts", "{verdicts}"),
        ),
        benchmark="contact plan",
        where=quiet,
    ),
    "criteria": Table(
        "contact",
        STRUCTURE,
        (
            ("states", "{states}"),
            ("that slide", "{slides}"),
            ("verdicts that change at a ratio of 0.4", "{changed.ratio_04}"),
            ("at 1", "{changed.ratio_1}"),
            ("iterations of stable states", "{iterations}"),
        ),
        benchmark="contact criteria",
    ),
    "luck": Table(
        "luck",
        (("half", "{half}"), ("criterion", "{criterion}")),
        (
            ("runs", "{runs}"),
            ("solved, %", "{solved:%}"),
            ("spread of the cost", "{spread}"),
            ("with less than the promise, %", "{without_reserve:%}"),
        ),
        benchmark="luck halves",
        where=lambda record: "both" not in (record["half"], record["criterion"]),
    ),
    "general": Table(
        "general",
        (("structures", "{group}"),),
        (
            ("cases", "{cases}"),
            ("greedy, %, mean over cases", "{greedy.mean:%}"),
            ("median and range", "{greedy.median:%} ({greedy.least:%} to {greedy.most:%})"),
            ("one of 16 samples, %, mean over cases", "{sampled.mean:%}"),
            ("median and range", "{sampled.median:%} ({sampled.least:%} to {sampled.most:%})"),
        ),
        benchmark="general group",
    ),
    "support": Table(
        "support",
        STRUCTURE,
        (
            ("held once", fewest("once")),
            ("proven to be needed", "{once.least}"),
            ("held again", fewest("again")),
            ("and one prop", fewest("props_1")),
            ("and two", fewest("props_2")),
        ),
        benchmark="support robots",
        where=lambda record: record["parts"] > 30 and needs_robots(record),
    ),
    "state-graphs": Table(
        "search",
        STRUCTURE,
        (("states at width 128", "{states}"), ("not found at width 64", "{unseen}"), ("paper", "{paper}")),
        benchmark="search graph",
        where=lambda record: record["width"] == 128,
    ),
    "agreement": Table(
        "stability",
        (),
        (
            ("states", total("states")),
            ("same verdict as the exact solver", total("agree")),
            ("certificates accepted", total("accepted")),
            ("undecided", total("undecided")),
        ),
        benchmark="stability verdicts",
    ),
    "certificates": Table(
        "stability",
        STRUCTURE,
        (
            ("states", "{states}"),
            ("stable", "{stable}"),
            ("unstable", "{unstable}"),
            ("undecided", "{undecided}"),
            ("certificates accepted", "{accepted}"),
        ),
        benchmark="stability certificates",
        where=lambda record: record["width"] == 64,
    ),
    "scaling": Table(
        "scaling",
        (("parts", "{parts}"),),
        (
            ("`equilibrium`, s", "{equilibrium_s}"),
            ("`contact`, from rest, s", "{contact_s}"),
            ("a next state, s", "{next_s}"),
        ),
        where=lambda record: record.get("time") == "processor",
    ),
    "judges": Table(
        "judges",
        STRUCTURE,
        (
            ("states", "{states}"),
            ("discrete elements, step by step", "{built.stands}"),
            ("each state from no stress", "{settled.stands}"),
            ("from the proven forces", "{proven.stands}"),
            ("replays under settings changed one at a time", "{varied_stands} of {varied}"),
        ),
        benchmark="judges plans",
        where=lambda record: (
            not record.get("robust") and min(record["built"]["stands"], record["settled"]["stands"]) < record["states"]
        ),
    ),
    "builds": Table(
        "judges",
        (("robots", "{robots}"),),
        (
            ("structures", lambda runs: str(len(runs))),
            ("built, contacts as of the criterion", counted("alike")),
            ("stiffer", counted("stiff")),
            ("soft", counted("soft")),
        ),
        benchmark="judges builds",
        where=lambda record: not record.get("judge"),
    ),
    "holds": Table(
        "holds",
        (*STRUCTURE, ("press", "{mode}")),
        (
            ("CPU time, s", "{processor_seconds}"),
            ("presses", "{presses}"),
            ("stands under all changes", lambda runs: "yes" if all(run["varied"] for run in runs) else "no"),
            ("states built", "{built} of {states}"),
        ),
        benchmark="holds modes",
    ),
    "shells": Table(
        "judges",
        (("family", "{family}"),),
        (("plans found", planned), ("built, contacts as of the criterion", counted("alike"))),
        benchmark="judges shells",
        where=lambda record: not record.get("judge"),
    ),
    "changes": Table(
        "changes",
        (("robots", "{robots}"),),
        (
            ("cases", lambda runs: str(len(runs))),
            ("with true friction", standing("true_falls")),
            ("with the reserve", standing("falls")),
            ("under sixteen extremes", standing("extremes")),
        ),
        benchmark="changes plans",
    ),
    "first-minute": Table(
        "first_minute",
        (("command", "{what}"), ("compiled code", "{cache}")),
        (("s", "{seconds}"),),
        benchmark="first_minute",
    ),
    "first-minute-ideas": Table(
        "first_minute",
        (("what is compiled at the first call", "{idea}"),),
        (("CPU time, s", "{processor_seconds}"),),
        benchmark="first_minute ideas",
    ),
    "margins-cost": Table(
        "margins",
        (*STRUCTURE, ("criterion", "{criterion}")),
        (
            ("friction, CPU ms", "{processor_ms.friction}"),
            ("push", "{processor_ms.push}"),
            ("all, of many states in one call", "{at_once.processor_ms}"),
        ),
        benchmark="margins cost",
    ),
    "margins-truth": Table(
        "margins",
        (),
        (
            ("replay: wrong side", "{wrong.replay} of {asked.replay}"),
            ("discrete elements: wrong side", "{wrong.discrete elements} of {asked.discrete elements}"),
        ),
        benchmark="margins truth",
    ),
    "margins-plans": Table(
        "margins",
        STRUCTURE,
        (
            ("first plan", "{first}"),
            ("maximised", "{maximised}"),
            ("any plan, at least", "{bound}"),
        ),
        benchmark="margins plans",
        where=lambda record: record["first"] - record["maximised"] > 0.2,
    ),
    "bricks": Table(
        "bricks",
        (("bricks", "{bricks}"),),
        (("plan, CPU s", "{plan_processor_s}"), ("verdict, CPU ms", "{verdict_processor_ms}")),
        benchmark="bricks cost",
    ),
    "gpu-published": Table(
        "gpu_stability",
        STRUCTURE,
        (("ratio", "{ratio.1024}"), ("in batches of 256", "{ratio.256}")),
        benchmark="gpu_stability published",
    ),
    "gpu-criteria": Table(
        "gpu_stability",
        STRUCTURE,
        (
            ("batches of 1,024, ms a state", "{ms_a_state.1024}"),
            ("of 16,384", "{ms_a_state.16384}"),
            ("same verdict as on the processor", "{same_as_cpu} of {states}"),
        ),
        where=lambda record: record.get("cone") == "quadratic" and record["criterion"] == "contact",
    ),
    "gpu-size": Table(
        "gpu_size",
        STRUCTURE,
        tuple((f"{batch:,}", f"{{ratio.{batch}}}") for batch in (1, 4, 16, 64, 256, 1024)),
    ),
    "gpu-search": Table(
        "gpu_search",
        (*STRUCTURE, ("criterion", "{criterion}")),
        (("seconds", "{seconds} ({seconds_range.0} to {seconds_range.1})"), ("of these verdicts", "{verdict_seconds}")),
        where=lambda record: (
            record["width"] == 4096
            and len(record["seeds"]) == 1
            and record["date"] >= "2026-11-27"  # levels are on the host since
            and record["structure"] in ("vault-62", "dome-72")
        ),
    ),
    "policies": Table(
        "learning",
        STRUCTURE_AND_ROBOTS,
        (
            ("success, %", "{test.success:%}"),
            ("seconds", "{seconds}"),
            ("and of searches, if apart", "{search_seconds}"),
            ("paper, %", "{paper.test:%}"),
        ),
        benchmark=("learning table3", "learning draws"),
        where=of_wide_data,
    ),
    "paper-table-3": Table(
        "learning",
        STRUCTURE_AND_ROBOTS,
        (
            ("mean over draws, %", over_draws("success", "%")),
            ("paper, %", "{paper.test:%}"),
            ("mean distance", over_draws("distance")),
            ("seconds", "{seconds}"),
        ),
        benchmark="learning draws",
        where=of_paper_data,
        newest="label",
    ),
    "transfer": Table(
        "policies",
        (("begins with", "{from}"), ("trained on dog-35, s", "{fine_tuned}")),
        (("unseen states of dog-35, %", "{success.test:%}"), ("states of training, %", "{success.train:%}")),
        benchmark="policies transfer",
        where=lambda record: record.get("tested_on") == "dog-35" and record["trained_on"] == "bottle-12",
    ),
    "pairs": Table(
        "learning",
        (*STRUCTURE, ("further searches", "{searches}")),
        PAIRS,
        benchmark="learning table4",
        where=lambda record: (
            record["goal_conditioned"]
            and "random" in record["test"]
            and (record["structure"] not in ("vault-62", "dome-72") or record.get("label") == "removals")
        ),
    ),
    "goal-recipes": Table(
        "learning",
        (*STRUCTURE, ("recipe", "{label}")),
        PAIRS,
        benchmark="learning table4",
        where=lambda record: record.get("label", "").startswith(("extended", "removals")),
    ),
    "paper-table-5": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("network", "{policy}")),
        (
            ("mean over draws, %", over_draws("success", "%")),
            ("states of training, %", "{train.success:%}"),
            ("seconds", "{seconds}"),
        ),
        benchmark="learning draws",
        where=lambda record: record.get("label", "").startswith("network-"),
    ),
    "fine-tuning": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("begins with", "{label}")),
        (("mean over draws, %", over_draws("success", "%")), ("seconds", "{seconds}")),
        benchmark="learning draws",
        where=lambda record: record.get("label") in ("tuned", "untuned"),
    ),
    "networks": Table(
        "learning",
        (*STRUCTURE, ("network", "{policy}")),
        (("unseen states, %", "{test.success:%}"),),
        benchmark="learning table5",
    ),
    "replanning-deadlines": Table(
        "replan",
        STRUCTURE,
        (
            *(
                (f"{seconds:g} s, {who}", of_policy(policy, seconds, lambda run: run["found"]))
                for seconds in (0.01, 0.1, 1.0)
                for who, policy in (("search", False), ("policy", True))
            ),
            ("median, search", of_policy(False, 1.0, lambda run: run["seconds"][1])),
            ("median, policy", of_policy(True, 1.0, lambda run: run["seconds"][1])),
        ),
        benchmark="replan deadline",
        where=lambda record: record["deadline"] in (0.01, 0.1, 1.0) and record["asked"] == 50,
        apart="policy",
    ),
    "service": Table(
        "service",
        STRUCTURE,
        (
            ("requests/s", "{per_second}"),
            ("p50, s", "{p50}"),
            ("p99, s", "{p99}"),
            ("slowest, s", "{max}"),
            ("with a plan", "{outcomes.found} of {requests}"),
        ),
        benchmark="service replan",
        where=lambda record: record["kind"] == "all" and quiet(record),
    ),
    "motion": Table(
        "motion",
        (("cell", "{cell}"),),
        (
            ("configurations/s", "{ours_per_second}"),
            ("Pinocchio and Coal", "{coal_per_second}"),
            ("missed collisions", "{missed} of {compared}"),
        ),
        benchmark="motion checks",
    ),
    "robots": Table(
        "robots",
        (("cell", "{cell}"), ("arms", "{robots}")),
        (
            ("found, and accepted by the check", "{checked_good} of {runs}"),
            ("median, s", "{seconds}"),
            ("paper, s", "{paper_seconds}"),
        ),
        where=lambda record: (
            "checked_good" in record and quiet(record) and not record["guided"] and record["runs"] < 20
        ),
    ),
    "robots-together": Table(
        "robots",
        (("cell", "{cell}"),),
        (
            ("makespan over that of one arm at a time", "{makespan_share}"),
            ("makespan, s", "{makespan}"),
            ("more CPU time, s", "{extra_cpu_seconds}"),
            ("passed the check", "{check}"),
        ),
        benchmark="robots together seed",
    ),
    "robots-delays": Table(
        "robots",
        (("cell", "{cell}"),),
        (
            ("pairs of motions that can coincide", "{overlaps}"),
            ("found to collide or out of order", "{problems}"),
            ("proof, CPU s", "{proof_cpu_seconds}"),
            ("waits without which arms collide", "{unsafe} of {removed}"),
        ),
        benchmark="robots delays",
        where=lambda record: record["direction"] == "assembly",
    ),
}
