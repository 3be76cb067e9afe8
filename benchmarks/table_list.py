"""Definitions of the tables that `benchmarks/tables.py` generates: their records and columns."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean

from table_model import Record, Runs, Table, look_up, number, spread


def quiet(record: Record) -> bool:
    """Return whether the machine was idle before the run, as far as is known; other runs count, but are not timed."""
    return record.get("load_before", 0) <= 2


def on_gpu(record: Record) -> bool:
    """Return whether a run was made on a GPU."""
    return "NVIDIA" in record["device"]


def all_states(record: Record) -> bool:
    """Return whether a policy was evaluated on all states, after training on the states of wide searches on a GPU."""
    return record["data"] == "wide" and record["evaluated"] == "all states" and on_gpu(record)


def random_fails(record: Record) -> bool:
    """Return whether unseen pairs are such that random actions do not solve; older runs have no share of them."""
    return "random" in record["test"]


def earlier_success(_: Runs, earlier: Runs) -> str:
    """Write the success of all earlier runs."""
    found = [look_up(run, "test.success") for run in earlier]
    return f"{spread(found, '%')}, {len(found)} run{'s' if len(found) > 1 else ''}" if found else ""


def over_draws(key: str, form: str = "", *, pairing: bool = False) -> Callable[[Runs, Runs], str]:
    """Return a column with the mean and the range of a figure over all test draws of all runs.

    Args:
        key: name of the figure of a draw.
        form: of the numbers.
        pairing: only the draws whose search has the seed of the training draw.
    """

    def write(runs: Runs, _: Runs) -> str:
        draws = [draw for run in runs for draw in run["draws"] if draw["published_pairing"] or not pairing]
        values = [draw[key] for draw in draws]
        mean, low, high = (number(value, form) for value in (fmean(values), min(values), max(values)))
        return mean if low == high else f"{mean} ({low} to {high})"

    return write


def at_distance(least: int, most: int) -> Callable[[Runs, Runs], str]:
    """Return a column with the share of success on states of all draws at some distances, and their number."""

    def write(runs: Runs, _: Runs) -> str:
        bins = [one for run in runs for draw in run["draws"] for one in draw["by_distance"].items()]
        chosen = [(count, share) for far, (count, share) in bins if least <= int(far) <= most]
        states = sum(count for count, _ in chosen)
        return f"{number(sum(n * share for n, share in chosen) / states, '%')} of {states:,}" if states else ""

    return write


def draws(runs: Runs, _: Runs) -> str:
    """Write the number of training and of test draws."""
    trained = {run["seeds"][0] for run in runs}
    return f"{len(trained)} and {sum(len(run['draws']) for run in runs)}"


def answered(policy: bool) -> Callable[[Runs, Runs], str]:
    """Return a column with the number of requests that got a plan in time, with a policy or without."""

    def write(runs: Runs, _: Runs) -> str:
        run = next((run for run in runs if run["policy"] is policy), None)
        return "" if run is None else f"{run['found']} of {run['asked']}"

    return write


def by_policy(runs: Runs, _: Runs) -> str:
    """Write how many plans came from the policy itself."""
    run = next((run for run in runs if run["policy"]), None)
    decided = {} if run is None else run["decided_by"]
    return "" if run is None else str(sum(count for stage, count in decided.items() if stage.startswith("policy")))


def fewest(rules: str) -> Callable[[Runs, Runs], str]:
    """Return a column with the fewest robots with which a plan was found under some rules, and why not with fewer."""

    def write(runs: Runs, _: Runs) -> str:
        run = next((run for run in runs if rules in run), None)
        if run is None:
            return ""
        answer = run[rules]
        robots = answer.get("impossible") or ("none found" if answer["robots"] is None else str(answer["robots"]))
        ended = {"deadline": "deadline", "search": "searches ended"}.get(answer.get("ended", ""), "")
        return f"{robots} ({ended})" if ended and not answer.get("impossible") else robots

    return write


def exhaustive(runs: Runs, _: Runs) -> str:
    """Write the fewest robots of exhaustive searches under the rules of each question, `open` where they gave up."""
    answers = next((run["exhaustive"] for run in runs if "exhaustive" in run), {})
    return ", ".join("open" if robots is None else str(robots) for robots in answers.values())


def how_runs_ended(runs: Runs, _: Runs) -> str:
    """Write how often searches ended otherwise than with a plan."""
    ended = runs[-1]["ended"]
    return ", ".join(f"{count} {name}" for name, count in ended.items() if name != "found")


STRUCTURE = (("structure", "{structure}"),)
STRUCTURE_AND_ROBOTS = (("structure", "{structure}"), ("robots", "{robots}"))
SEARCHES_COMPARED = (
    ("commit before", "{before_commit}"),
    ("verdicts", "{verdicts}"),
    ("before", "{before.verdicts}"),
    ("CPU time, s", "{cpu_seconds}"),
    ("before", "{before.cpu_seconds}"),
    ("ratio", "{cpu_ratio}"),
    ("time, s", "{seconds}"),
    ("before", "{before.seconds}"),
    ("plans found", "{found}"),
    ("before", "{before.found}"),
    ("memory, GiB", "{memory_gib}"),
)

LUCK = (
    ("solved, %", "{solved:%}"),
    ("not all alike, % of the cases", "{mixed:%}"),
    ("spread of the cost", "{spread}"),
    ("cost, median", "{cost.median}"),
    ("90 %", "{cost.ninety}"),
    ("without the reserve, %", "{without_reserve:%}"),
    ("other ends", how_runs_ended),
    ("CPU time, s", "{processor_seconds}"),
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

DRAWS = (
    ("training and test draws", draws),
    ("unseen states, mean over draws, %", over_draws("success", "%")),
    ("paper, %", "{paper.test:%}"),
    ("draw of the same seed, %", over_draws("success", "%", pairing=True)),
    ("distance to the training states", over_draws("distance")),
    ("validation states, %", "{validation.success:%}"),
    ("seconds", "{seconds}"),
)
"""Columns of policies that are tested on several draws."""


TABLES = {
    "plans": Table(
        "contact",
        STRUCTURE,
        (
            ("plan with proofs and replay, s", "{seconds}"),
            ("without proofs and last replay, s", "{seconds_before_replay}"),
            ("verdicts", "{verdicts}"),
            ("states of the plans that fail the replay", "{states_that_fail_the_replay} of {states}"),
        ),
        benchmark="contact plan",
        where=quiet,
    ),
    "contact-verdicts": Table(
        "contact",
        STRUCTURE,
        (
            ("states", "{asked}"),
            ("contact, ms a state", "{ms_each.contact}"),
            ("equilibrium, ms a state", "{ms_each.equilibrium}"),
            ("ratio", "{ratio}"),
            ("repetitions", "{repeat}"),
            ("one verdict without a neighbour, ms", "{cold_ms}"),
        ),
        benchmark="contact verdicts",
        where=quiet,
    ),
    "contact-steps": Table(
        "contact",
        STRUCTURE,
        (
            ("parts", "{parts}"),
            ("states", "{states}"),
            ("from the state before, ms of processor time", "{ms_each.beside}"),
            ("from rest, ms", "{ms_each.from rest}"),
            ("same verdict", "{agree}"),
        ),
        benchmark="contact steps",
    ),
    "judges": Table(
        "judges",
        STRUCTURE,
        (
            ("states", "{states}"),
            ("replay", "{replay.stands}"),
            ("replays under other numbers that stand", "{varied_stands} of {varied}"),
            ("discrete elements, step by step", "{built.stands}"),
            ("from the proven forces", "{proven.stands}"),
            ("from nothing", "{settled.stands}"),
            ("LMGC90: stand, fall, not judged", "{lmgc90.stands}, {lmgc90.falls}, {lmgc90.not judged}"),
        ),
        benchmark="judges plans",
        where=lambda record: not record.get("robust"),
    ),
    "builds": Table(
        "judges",
        (*STRUCTURE_AND_ROBOTS, ("reserve asked for", "{asked_reserve}")),
        (
            ("states", "{states}"),
            ("presses", "{presses}"),
            ("contacts as of the criterion: stand, open, fall", "{alike.stands}, {alike.open}, {alike.falls}"),
            ("stiff contacts", "{stiff.stands}, {stiff.open}, {stiff.falls}"),
            ("soft contacts", "{soft.stands}, {soft.open}, {soft.falls}"),
        ),
        benchmark="judges builds",
    ),
    "shells": Table(
        "judges",
        (*STRUCTURE_AND_ROBOTS, ("reserve asked for", "{asked_reserve}"), ("judge in the search", "{judge}")),
        (
            ("parts", "{parts}"),
            ("search", "{ended}"),
            ("reserve", "{reserve}"),
            ("states", "{states}"),
            ("presses", "{presses}"),
            ("contacts as of the criterion: stand, open, fall", "{alike.stands}, {alike.open}, {alike.falls}"),
            ("stiff contacts", "{stiff.stands}, {stiff.open}, {stiff.falls}"),
        ),
        benchmark="judges shells",
    ),
    "robust": Table(
        "judges",
        STRUCTURE,
        (
            ("states", "{states}"),
            ("search, s of processor time", "{processor_seconds}"),
            ("replays under other numbers that stand", "{varied_stands} of {varied}"),
            ("discrete elements, step by step", "{built.stands}"),
            ("from the proven forces", "{proven.stands}"),
            ("from nothing", "{settled.stands}"),
        ),
        benchmark="judges plans",
        where=lambda record: bool(record.get("robust")),
    ),
    "replays": Table(
        "contact",
        STRUCTURE,
        (("states", "{states}"), ("replay of a plan, s", "{seconds}"), ("repetitions", "{repeat}")),
        benchmark="contact replay",
        where=quiet,
    ),
    "agreement": Table(
        "stability",
        STRUCTURE,
        (
            ("same verdict as the exact solver", "{agree} of {states}"),
            ("certificates accepted", "{accepted} of {states}"),
            ("undecided", "{undecided}"),
        ),
        benchmark="stability verdicts",
    ),
    "stability": Table(
        "stability",
        STRUCTURE,
        (
            ("ms a state", "{milliseconds}"),
            ("exact solver, one core, ms a state", "{exact_milliseconds}"),
            ("ratio, with a neighbouring state", "{speedup}"),
            ("ratio, without", "{speedup_alone}"),
        ),
        benchmark="stability verdicts",
        where=quiet,
    ),
    "cold": Table(
        "stability",
        STRUCTURE,
        (("one verdict without a neighbour, ms", "{verdict_milliseconds}"),),
        benchmark="stability cold",
        where=quiet,
    ),
    "margins-cost": Table(
        "margins",
        (*STRUCTURE, ("criterion", "{criterion}")),
        (
            ("states", "{states}"),
            ("friction, CPU ms", "{processor_ms.friction}"),
            ("tilt, CPU ms", "{processor_ms.tilt}"),
            ("weight of a part, CPU ms", "{processor_ms.load_factor}"),
            ("push, CPU ms", "{processor_ms.push}"),
            ("before, times as long", "{ratio.all}"),
            ("states in one call", "{at_once.states}"),
            ("all margins of one of them, CPU ms", "{at_once.processor_ms}"),
            ("before", "{before_at_once.processor_ms}"),
        ),
        benchmark="margins cost",
    ),
    "margins-truth": Table(
        "margins",
        (("cases", "{cases}"),),
        (
            ("replay: wrong side", "{wrong.replay} of {asked.replay}"),
            ("discrete elements: wrong side", "{wrong.discrete elements} of {asked.discrete elements}"),
            ("of those inside, at rest from our forces", "{from_forces.stands} of {from_forces.asked}"),
            ("their bound over ours, in these cases", "{limits}"),
        ),
        benchmark="margins truth",
    ),
    "margins-plans": Table(
        "margins",
        STRUCTURE_AND_ROBOTS,
        (
            ("friction of the structure", "{friction}"),
            ("least friction of the first plan", "{first}"),
            ("of the maximised plan", "{maximised}"),
            ("of any plan, at least", "{bound}"),
            ("first plan, CPU s", "{first_processor_s}"),
            ("maximised plan with its margins, CPU s", "{maximise_processor_s}"),
        ),
        benchmark="margins plans",
    ),
    "bricks": Table(
        "bricks",
        (("bricks", "{bricks}"), ("contact points", "{points}"), ("robots", "{robots}")),
        (
            ("steps of the plan", "{steps}"),
            ("plan, CPU s", "{plan_processor_s}"),
            ("verdict, CPU ms", "{verdict_processor_ms}"),
            ("verdict from the state before, CPU ms", "{next_verdict_processor_ms}"),
            ("verdict of 100 bricks in a batch, CPU ms", "{processor_ms_per_100_bricks}"),
        ),
        benchmark="bricks cost",
    ),
    "first-minute": Table(
        "first_minute",
        (("command", "{what}"), ("compiled code", "{cache}")),
        (
            ("s", "{seconds}"),
            ("CPU time, s", "{processor_seconds}"),
            ("before, s", "{before.processor_seconds}"),
            ("ratio", "{ratio}"),
            ("memory, GiB", "{peak_gib}"),
            ("runs", "{runs}"),
        ),
        benchmark="first_minute",
    ),
    "first-minute-ideas": Table(
        "first_minute",
        (("what is compiled at the first call", "{idea}"),),
        (("CPU time, s", "{processor_seconds}"),),
        benchmark="first_minute ideas",
    ),
    "search-plans": Table(
        "search",
        (*STRUCTURE, ("criterion", "{criterion}")),
        (("meshes to proven plan, s", "{seconds}"), ("search, s", "{search_seconds}"), ("verdicts", "{verdicts}")),
        benchmark="search plan",
        where=quiet,
    ),
    "search-compare": Table(
        "search_compare",
        STRUCTURE_AND_ROBOTS,
        SEARCHES_COMPARED,
        benchmark="search_compare plans",
        where=lambda record: record.get("criterion") != "equilibrium",
    ),
    "search-compare-equilibrium": Table(
        "search_compare",
        STRUCTURE_AND_ROBOTS,
        SEARCHES_COMPARED,
        benchmark="search_compare plans",
        where=lambda record: record.get("criterion") == "equilibrium",
    ),
    "luck": Table(
        "luck",
        (("measured commit", "{source}"), ("half", "{half}"), ("criterion", "{criterion}")),
        (("structures", "{structures}"), ("cases", "{cases}"), ("runs", "{runs}"), *LUCK),
        benchmark="luck halves",
    ),
    "luck-cases": Table(
        "luck",
        (*STRUCTURE_AND_ROBOTS, ("criterion", "{criterion}")),
        (("half", "{half}"), ("parts", "{parts}"), *(column for column in LUCK if "cases" not in column[0])),
        benchmark="luck cases",
    ),
    "rules": Table(
        "rules",
        RULES_KEY,
        RULES,
        benchmark="rules sweep",
        where=lambda record: record["half"] == "both" and record["criterion"] != "both",
    ),
    "search-bound": Table(
        "search",
        STRUCTURE,
        (
            ("parts", "{parts}"),
            ("robots proven to be needed", "{least}"),
            ("parts of the core that proves it", "{core}"),
            ("verdicts", "{verdicts}"),
            ("CPU time, s", "{cpu_seconds}"),
        ),
        benchmark="search bound",
    ),
    "state-graphs": Table(
        "search",
        (*STRUCTURE, ("width", "{width}")),
        (("states", "{states}"), ("not found at width 64", "{unseen}"), ("paper", "{paper}")),
        benchmark="search graph",
    ),
    "contacts": Table("contacts", STRUCTURE, (("contacts, s", "{seconds}"),), where=quiet),
    "clearance": Table(
        "clearance", (*STRUCTURE, ("directions", "{directions}")), (("clearance table, s", "{seconds}"),), where=quiet
    ),
    "scaling": Table(
        "scaling",
        (("parts", "{parts}"),),
        (
            ("contact points", "{contact_points}"),
            ("contacts, s", "{contacts_s}"),
            ("problem, s", "{problem_s}"),
            ("verdict with proof under `equilibrium`, s", "{equilibrium_s}"),
            ("under `contact`, from rest, s", "{contact_s}"),
            ("iterations", "{iterations}"),
            ("verdict of a next state, s", "{next_s}"),
            ("memory, GiB", "{memory_gib}"),
        ),
        where=lambda record: record.get("time") == "processor",
    ),
    "scaling-exponents": Table(
        "scaling",
        (("", "fitted exponent"),),
        tuple(
            (name, f"{{exponent.{name}}}")
            for name in ("contacts_s", "problem_s", "equilibrium_s", "contact_s", "next_s", "memory_gib")
        ),
        benchmark="scaling fit",
        where=lambda record: record.get("time") == "processor",
    ),
    "planning": Table(
        "scaling",
        (("criterion", "{criterion}"), ("robots", "{robots}"), ("parts", "{parts}")),
        (
            ("plan found", "{found}"),
            ("steps reached", "{reached} of {steps}"),
            ("verdicts", "{verdicts}"),
            ("contacts, s", "{contacts_s}"),
            ("search, s", "{search_s}"),
            ("proofs, s", "{proofs_s}"),
            ("all, s", "{plan_s}"),
            ("memory, GiB", "{memory_gib}"),
        ),
        benchmark="scaling plan",
    ),
    "planning-exponents": Table(
        "scaling",
        (("criterion", "{criterion}"), ("robots", "{robots}"), ("parts, median and range", "{parts}")),
        tuple(
            (name, f"{{exponent.{name}}}") for name in ("contacts_s", "search_s", "proofs_s", "plan_s", "memory_gib")
        ),
        benchmark="scaling plan fit",
        where=lambda record: len(record["parts"]) > 2,
    ),
    "free-edges": Table(
        "free_edges",
        (("case", "{case}"), ("contact history", "{history}"), ("robots", "{robots}")),
        (
            ("parts near the edge", "{parts}"),
            ("edge closes", "{closes}"),
            ("every order tried", "{exhaustive}"),
            ("steps reached", "{levels} of {steps}"),
            ("most states at a level", "{widest}"),
            ("verdicts", "{verdicts}"),
            ("undecided", "{undecided}"),
            ("CPU time, s", "{cpu_seconds}"),
        ),
    ),
    "gpu-stability": Table(
        "gpu_stability",
        (*STRUCTURE, ("states", "{states} {drawn_from}")),
        (
            ("device time, batches of 1,024, ms a state", "{ms_a_state.1024}"),
            ("of 16,384", "{ms_a_state.16384}"),
            ("whole call with certificates, 1,024, ms a state", "{check_ms.1024}"),
            ("published method, re-implemented, ms a state", "{shared_inverse.ms_a_state}"),
            ("ratio of device times", "{shared_inverse.ms_a_state/ms_a_state.1024}"),
            ("ratio of whole calls", "{shared_inverse.ms_a_state/check_ms.1024}"),
            ("wrong: published method", "{shared_inverse.wrong} of {shared_inverse.states}"),
            ("same verdict as on the processor", "{same_as_cpu} of {states}"),
        ),
        where=lambda record: bool(record.get("shared_inverse")),
    ),
    "gpu-published": Table(
        "gpu_stability",
        STRUCTURE,
        (
            ("published implementation, ms a state", "{published_ms}"),
            ("device time, batches of 1,024, ms a state", "{ms_a_state.1024}"),
            ("ratio", "{ratio.1024}"),
            ("ratio in batches of 256", "{ratio.256}"),
        ),
        benchmark="gpu_stability published",
    ),
    "gpu-errors": Table(
        "gpu_stability",
        (("states", "{states}"),),
        (
            ("wrong: falsework", "{wrong}"),
            ("published implementation, the paper's settings", "{published_wrong}"),
            ("published implementation, its defaults", "{published_wrong_defaults}"),
        ),
        benchmark="gpu_stability published-errors",
    ),
    "gpu-criteria": Table(
        "gpu_stability",
        (*STRUCTURE, ("criterion", "{criterion}")),
        (
            ("batches of 1,024, ms a state", "{ms_a_state.1024}"),
            ("of 4,096", "{ms_a_state.4096}"),
            ("of 16,384", "{ms_a_state.16384}"),
            ("same verdict as on the processor", "{same_as_cpu} of {states}"),
            ("undecided", "{verdicts.undecided}"),
        ),
        where=lambda record: record.get("cone") == "quadratic",
    ),
    "gpu-size": Table(
        "gpu_size",
        (*STRUCTURE, ("parts", "{parts}"), ("states", "{drawn_from}")),
        (
            ("1 state", "{ratio.1}"),
            *((f"{batch:,} states", f"{{ratio.{batch}}}") for batch in (4, 16, 64, 256, 1024, 4096)),
            ("ms for 256 on the GPU", "{gpu_ms.256}"),
            ("processor cores", "{cores}"),
        ),
    ),
    "gpu-counters": Table(
        "gpu_stability",
        (*STRUCTURE, ("method", "{method}")),
        (
            ("ms for 16,384 states", "{ms}"),
            ("TFLOP/s", "{tflop_per_s}"),
            ("% of the measured ceiling", "{percent_of_ceiling}"),
            ("% of issue slots", "{percent_of_issue_slots}"),
            ("% of warps resident", "{percent_of_warps}"),
            ("device memory, MB", "{memory_mb}"),
        ),
        benchmark="gpu_stability counters",
    ),
    "gpu-search": Table(
        "gpu_search",
        (*STRUCTURE, ("criterion", "{criterion}"), ("width", "{width}"), ("GPUs", "{processes}")),
        (("seconds", "{seconds}"), ("verdicts", "{asked}"), ("states found", "{states}")),
    ),
    "policies": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("criterion", "{criterion}")),
        (
            ("unseen states", "{test.states}"),
            ("success, %", "{test.success:%}"),
            ("seconds, data included", "{seconds}"),
            ("success in earlier runs, %", earlier_success),
            ("paper, %", "{paper.test:%}"),
            ("paper, hours", "{paper.hours}"),
        ),
        benchmark="learning table3",
        where=all_states,
    ),
    "recipes": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("searches to learn from", "{recipe}"), ("network", "{policy}")),
        (
            ("validation states, %", "{validation.success:%}"),
            ("unseen states, %", "{test.success:%}"),
            ("seconds", "{seconds}"),
            ("of these for data", "{data_seconds}"),
        ),
        benchmark="learning recipe",
    ),
    "data-collection": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("criterion", "{criterion}")),
        (("collecting data, s", "{data_seconds}"), ("states", "{states_learned_from}")),
        benchmark="learning data",
    ),
    "policies-short": Table(
        "training",
        (*STRUCTURE_AND_ROBOTS, ("criterion", "{criterion}")),
        (("success, %", "{test.success:%}"), ("unseen states", "{test.states}"), ("seconds", "{seconds}")),
    ),
    "policies-paper-data": Table(
        "learning",
        STRUCTURE_AND_ROBOTS,
        DRAWS,
        benchmark="learning draws",
        where=lambda record: (
            record["data"] == "width64" and record["label"] == "reinforcement" and record["rollouts"] == 8192
        ),
    ),
    "policies-distance": Table(
        "learning",
        STRUCTURE_AND_ROBOTS,
        (
            ("distance 1, %", at_distance(1, 1)),
            ("2 to 4", at_distance(2, 4)),
            ("5 to 7", at_distance(5, 7)),
            ("8 to 11", at_distance(8, 11)),
            ("12 and more", at_distance(12, 1000)),
        ),
        benchmark="learning draws",
        where=lambda record: (
            (record["data"], record["label"], record["rollouts"]) == ("width64", "reinforcement", 8192)
            and record["policy"] == "transformer"
        ),
    ),
    "policies-recipes": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("recipe", "{label}"), ("rollouts", "{rollouts}")),
        DRAWS,
        benchmark="learning draws",
        where=lambda record: (
            record["data"] == "width64" and record["structure"] not in ("dome-37", "tetris-14", "tetris-17")
        ),
    ),
    "policies-wide": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("recipe", "{label}"), ("rollouts", "{rollouts}")),
        DRAWS,
        benchmark="learning draws",
        where=lambda record: record["data"] == "wide",
    ),
    "policies-one-draw": Table(
        "learning",
        STRUCTURE_AND_ROBOTS,
        (
            ("unseen states, %", "{test.success:%}"),
            ("network", "{policy}"),
            ("paper, %", "{paper.test:%}"),
            ("training states, %", "{train.success:%}"),
            ("seconds", "{seconds}"),
        ),
        benchmark="learning table3",
        where=lambda record: record["data"] == "width64",
    ),
    "pairs": Table(
        "learning",
        (*STRUCTURE, ("further searches", "{searches}"), ("network", "{policy}")),
        (
            ("unseen pairs", "{test.states}"),
            ("success, %", "{test.success:%}"),
            ("uniformly random legal actions, %", "{test.random:%}"),
            ("steps of a pair, median", "{test.steps.median}"),
            ("validation pairs, %", "{validation.success:%}"),
            ("training pairs, %", "{train.success:%}"),
            ("random actions, %", "{train.random:%}"),
            ("seconds", "{seconds}"),
        ),
        benchmark="learning table4",
        where=lambda record: record["goal_conditioned"] and random_fails(record),
    ),
    "pairs-goal-blind": Table(
        "learning",
        STRUCTURE,
        (
            ("unseen pairs, %", "{test.success:%}"),
            ("uniformly random legal actions, %", "{test.random:%}"),
            ("training pairs, %", "{train.success:%}"),
            ("seconds", "{seconds}"),
        ),
        benchmark="learning table4",
        where=lambda record: not record["goal_conditioned"] and random_fails(record),
    ),
    "solvable": Table(
        "learning",
        (*STRUCTURE_AND_ROBOTS, ("criterion", "{criterion}")),
        (
            ("solvable states", "{states}"),
            ("of these held out for test and validation", "{held_out}"),
            ("held out but not solvable", "{held_out_unsolvable}"),
        ),
        benchmark="learning solvable",
    ),
    "networks": Table(
        "learning",
        (*STRUCTURE, ("network", "{policy}")),
        (
            ("criterion", "{criterion}"),
            ("unseen states, %", "{test.success:%}"),
            ("validation states, %", "{validation.success:%}"),
            ("training states, %", "{train.success:%}"),
            ("optimizer steps", "{steps}"),
            ("seconds", "{seconds}"),
        ),
        benchmark="learning table5",
    ),
    "network-cost": Table(
        "policies",
        (("network", "{kind}"), ("structure", "{structure}")),
        (
            ("layers", "{layers}"),
            ("channels", "{channels}"),
            ("weights", "{parameters}"),
            ("operations a state, forward", "{flops_forward}"),
        ),
        benchmark="policies cost",
    ),
    "network-speed": Table(
        "policies",
        (("network", "{kind}"), ("compiled", "{compiled}")),
        (
            ("evaluated, states/s", "{states_per_second.evaluated}"),
            ("trained on, states/s", "{states_per_second.trained}"),
            ("memory, GB", "{memory_gb}"),
        ),
        benchmark="policies speed",
    ),
    "transfer": Table(
        "policies",
        (("network", "{kind}"), ("trained on", "{source}"), ("evaluated on", "{target}")),
        (("its unseen states, %", "{test_success:%}"), ("the same, fine-tuned, %", "{fine_tuned_success:%}")),
        benchmark="policies transfer",
    ),
    "environment": Table(
        "environment",
        (*STRUCTURE, ("work", "{row}"), ("processes", "{processes}")),
        (
            ("environment steps/s", "{steps_a_second}"),
            ("environments at once", "{rollouts_at_once}"),
            ("times MaskablePPO of sb3-contrib", "{times_sb3}"),
        ),
    ),
    "replanning": Table(
        "replan",
        (*STRUCTURE, ("device", "{device}")),
        (
            ("median, s", "{seconds.1}"),
            ("slowest, s", "{seconds.3}"),
            ("with a plan", "{found} of {asked}"),
            ("paper, s", "{paper_seconds}"),
        ),
        benchmark="replan complete",
        where=quiet,
    ),
    "replanning-midway": Table(
        "replan",
        STRUCTURE,
        (
            ("median, s", "{seconds.1}"),
            ("95 %, s", "{seconds.2}"),
            ("slowest, s", "{seconds.3}"),
            ("with a plan", "{found} of {asked}"),
        ),
        benchmark="replan midway",
        where=quiet,
    ),
    "replanning-deadlines": Table(
        "replan",
        (*STRUCTURE, ("deadline, s", "{deadline}")),
        (
            ("plans in time, search alone", answered(False)),
            ("with a policy", answered(True)),
            ("of these by the policy itself", by_policy),
        ),
        benchmark="replan deadline",
    ),
    "replanning-batch": Table(
        "replan",
        (*STRUCTURE, ("requests together", "{together}")),
        (("answers/s", "{answers_per_second}"),),
        benchmark="replan batch",
        where=quiet,
    ),
    **{
        f"service-{what}": Table(
            "service",
            STRUCTURE,
            (
                ("requests/s", "{per_second}"),
                ("scheduled", "{scheduled_per_second}"),
                ("errors", "{errors}"),
                ("p50, s", "{p50}"),
                ("p99, s", "{p99}"),
                ("slowest, s", "{max}"),
                ("with a plan", "{outcomes.found} of {requests}"),
                ("cores used", "{cores}"),
            ),
            benchmark=f"service {what}",
            where=lambda record: record["kind"] in ("all", "200 ms") and quiet(record),
        )
        for what in ("replan", "stability", "deadline")
    },
    "motion": Table(
        "motion",
        (("cell", "{cell}"), ("shapes", "{shapes}")),
        (
            ("configurations/s", "{ours_per_second}"),
            ("Pinocchio and Coal", "{coal_per_second}"),
            ("missed collisions", "{missed} of {compared}"),
            ("too careful", "{too_careful}"),
        ),
        benchmark="motion checks",
    ),
    **{
        f"motion-{what}": Table(
            "motion",
            (("cell", "{cell}"),),
            (
                ("found", "{found} of {plans}"),
                ("median, ms", "{ours_ms_median}"),
                ("95 %, ms", "{ours_ms_95}"),
                ("OMPL, found", "{ompl_found} of {ompl_plans}"),
                ("OMPL, median, ms", "{ompl_ms_median}"),
                ("OMPL, 95 %, ms", "{ompl_ms_95}"),
            ),
            benchmark=f"motion plan {what}",
        )
        for what in ("free", "carried")
    },
    "robots": Table(
        "robots",
        (("cell", "{cell}"), ("arms", "{robots}"), ("policy as guide", "{guided}")),
        (
            ("found", "{found} of {runs}"),
            ("passed the independent check", "{checked_good} of {runs}"),
            ("median, s", "{seconds}"),
            ("paper, s", "{paper_seconds}"),
        ),
        where=lambda record: "checked_good" in record and quiet(record),
    ),
    "robots-contact": Table(
        "robots",
        (("cell", "{cell}"), ("arms", "{robots}")),
        (
            ("plan found", "{found}"),
            ("CPU time, s", "{cpu_seconds}"),
            ("searches", "{attempts}"),
            ("dead ends", "{dead_ends}"),
            ("passed the independent check", "{check}"),
        ),
        benchmark="robots plan",
        where=lambda record: record.get("criterion") == "contact",
    ),
    "robots-midway": Table(
        "robots",
        (("cell", "{cell}"), ("arms", "{robots}")),
        (
            ("plans from midway", "{runs}"),
            ("CPU time, s", "{fresh_cpu_seconds}"),
            ("CPU time with graph and verdicts of the first plan, s", "{kept_cpu_seconds}"),
        ),
        benchmark="robots midway",
    ),
    "robots-continued": Table(
        "robots",
        (("cell", "{cell}"),),
        (
            ("interruptions", "{runs}"),
            ("all plans found", "{found}"),
            ("holding", "{holding}"),
            ("carrying", "{carrying}"),
            ("passed the independent check", "{checked_good}"),
            ("one at a time, CPU s", "{sequential_cpu_seconds}"),
            ("together, CPU s", "{together_cpu_seconds}"),
            ("command line, one at a time, CPU s", "{command_cpu_seconds}"),
            ("of these within 2 s", "{within_two_seconds}"),
        ),
        benchmark="robots continued",
    ),
    "robots-together": Table(
        "robots",
        (("cell", "{cell}"),),
        (
            ("plan found", "{found}"),
            ("makespan over the plan of one arm at a time", "{makespan_share}"),
            ("makespan, s", "{makespan}"),
            ("lower bound, s", "{lower_bound}"),
            ("more time, s", "{extra_seconds}"),
            ("more CPU time, s", "{extra_cpu_seconds}"),
            ("passed the independent check", "{check}"),
        ),
        benchmark="robots together seed",
    ),
    "robots-delays": Table(
        "robots",
        (("cell", "{cell}"), ("order", "{direction}")),
        (
            ("motions and grips", "{motions}"),
            ("pairs of motions and rests that can coincide", "{overlaps}"),
            ("motions among parts that stand only by delay", "{early}"),
            ("found to collide or out of order", "{problems}"),
            ("proof, CPU s", "{proof_cpu_seconds}"),
            ("random runs", "{delayed}"),
            ("of them out of order, stuck, outside the proof", "{out_of_order}, {stuck}, {outside}"),
            ("makespan of runs, s", "{delayed_makespan}"),
            ("without delays", "{makespan}"),
            ("waits left out", "{removed}"),
            ("that then allow a collision", "{unsafe}"),
        ),
        benchmark="robots delays",
    ),
    "robots-support": Table(
        "robots",
        (("cell", "{cell}"), ("parts held again", "{support}")),
        (
            ("plan found", "{found}"),
            ("searches", "{attempts}"),
            ("dead ends", "{dead_ends}"),
            ("releases in the plan", "{released}"),
            ("CPU time, s", "{cpu_seconds}"),
            ("motion, s", "{motion_seconds}"),
            ("passed the independent check", "{check}"),
        ),
        benchmark="robots support seed",
    ),
    "support": Table(
        "support",
        STRUCTURE,
        (
            ("parts", "{parts}"),
            ("floor", "{floor}"),
            ("places for props", "{places}"),
            ("fewest robots, every part held once", fewest("once")),
            ("proven to be needed", "{once.least}"),
            ("holding again", fewest("again")),
            ("and one prop", fewest("props_1")),
            ("and two props", fewest("props_2")),
            ("by exhaustive search", exhaustive),
            ("deadline of each question, s", "{deadline}"),
            ("memory, GiB", "{memory_gib}"),
        ),
        benchmark="support robots",
    ),
    "viewer": Table("viewer", (("parts", "{parts}"),), (("one step of the page, ms", "{step_ms}"),), "viewer page"),
}
