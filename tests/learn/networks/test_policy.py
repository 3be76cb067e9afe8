"""Laws of every policy, whatever its network."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
import torch

from falsework import Assembly, load_structure
from falsework.assembly.state import action_mask
from falsework.errors import InputError
from falsework.geometry import TriangleMesh
from falsework.learn import PolicySettings, confidences, make_policy, masked_log_probabilities, transfer
from falsework.learn.config.policy import recommended
from falsework.learn.config.train import from_dict
from falsework.learn.networks.factory import describe, share

KINDS = ("transformer", "local", "gat", "mlp", "resmlp")
TRANSFER = ("transformer", "local", "gat")
SMALL = {"layers": 2, "channels": 16, "heads": 2}


def settings_of(kind: str, **options: object) -> PolicySettings:
    return PolicySettings(kind, **{**SMALL, **options})  # type: ignore[arg-type]


def random_states(assembly: Assembly, count: int, seed: int = 0, values: int = 3) -> torch.Tensor:
    states = np.random.default_rng(seed).integers(0, values, (count, assembly.part_count), dtype=np.uint8)
    states[:, assembly.boundary] = 2
    return torch.from_numpy(states)


def mask_of(assembly: Assembly, states: torch.Tensor, robots: int = 2) -> torch.Tensor:
    return torch.from_numpy(action_mask(states.numpy(), assembly.boundary, robots))


def changed(assembly: Assembly, order: np.ndarray | None = None, shift: object = 0.0, scale: float = 1.0) -> Assembly:
    """The same structure with its parts renumbered (new part k is old part order[k]), moved and scaled."""
    order = np.arange(assembly.part_count) if order is None else order
    meshes = [assembly.meshes[part] for part in order.tolist()]
    moved = [
        TriangleMesh.from_arrays(mesh.name, scale * (mesh.vertices + np.asarray(shift)), mesh.faces) for mesh in meshes
    ]
    return Assembly.from_meshes(moved, boundary=assembly.boundary[order], density=assembly.density[order])


@pytest.fixture(scope="module")
def cube() -> Assembly:
    return load_structure("polycube")


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure("arch:blocks=7")


@pytest.fixture(scope="module")
def dome() -> Assembly:
    return load_structure("dome:rings=2,blocks=5")


@pytest.mark.parametrize("goal_conditioned", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_shapes_and_types(kind: str, goal_conditioned: bool, arch: Assembly) -> None:
    policy = make_policy(arch, settings_of(kind, goal_conditioned=goal_conditioned))
    states = random_states(arch, 5)
    logits, value = policy(states, states if goal_conditioned else None)
    assert logits.shape == (5, 2 * arch.part_count)
    assert value.shape == (5,)
    assert logits.dtype == value.dtype == torch.float32
    assert (value.abs() <= 1).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_is_judged_alone(kind: str, arch: Assembly) -> None:
    """What else is in the batch has no influence."""
    policy = make_policy(arch, settings_of(kind))
    states = random_states(arch, 6)
    logits, value = policy(states)
    for row in range(6):
        alone = policy(states[row : row + 1])
        torch.testing.assert_close(alone[0][0], logits[row], atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(alone[1][0], value[row], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_same_seed_same_weights(kind: str, arch: Assembly) -> None:
    one, same, other = (make_policy(arch, settings_of(kind), seed=seed).state_dict() for seed in (3, 3, 4))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert any(not torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("kind", KINDS)
def test_making_a_policy_leaves_the_random_numbers_alone(kind: str, arch: Assembly) -> None:
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    make_policy(arch, settings_of(kind))
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("kind", TRANSFER)
def test_renumbering_parts_renumbers_the_actions(kind: str, dome: Assembly) -> None:
    order = np.random.default_rng(2).permutation(dome.part_count)
    other = changed(dome, order)
    policy = make_policy(dome, settings_of(kind, goal_conditioned=True))
    twin = transfer(policy.state_dict(), policy.settings, other)
    states, targets = random_states(dome, 8), random_states(dome, 8, seed=1)
    logits, value = policy(states, targets)
    twin_logits, twin_value = twin(states[:, order], targets[:, order])
    both = np.concatenate([order, order + dome.part_count])
    torch.testing.assert_close(twin_logits, logits[:, both], atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(twin_value, value, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", TRANSFER)
@pytest.mark.parametrize(("shift", "scale"), [((3.0, -2.0, 5.0), 1.0), ((0.0, 0.0, 0.0), 0.25)])
def test_place_and_unit_do_not_matter(kind: str, shift: tuple[float, ...], scale: float, dome: Assembly) -> None:
    policy = make_policy(dome, settings_of(kind))
    twin = transfer(policy.state_dict(), policy.settings, changed(dome, shift=shift, scale=scale))
    states = random_states(dome, 4)
    for ours, theirs in zip(policy(states), twin(states), strict=True):
        torch.testing.assert_close(theirs, ours, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_probabilities_of_illegal_actions_are_exactly_zero(kind: str, cube: Assembly) -> None:
    """Among them removals that the clearance table forbids."""
    policy = make_policy(cube, settings_of(kind))
    states = random_states(cube, 64).clamp(min=1)  # nothing removed, so that parts are in each other's way
    mask = mask_of(cube, states, robots=15)
    clear = torch.from_numpy(cube.clearance.can_leave(states.numpy()))
    mask[:, cube.part_count :] &= clear
    blocked = (states == 2) & ~clear & ~policy.fixed
    probabilities = confidences(policy, states, mask)
    assert blocked.any()
    assert (probabilities[:, cube.part_count :][blocked] == 0).all()
    assert (probabilities[~mask] == 0).all()
    some = mask.any(dim=1)
    torch.testing.assert_close(probabilities[some].sum(dim=1), torch.ones(int(some.sum())))


def test_rows_without_a_legal_action_are_all_zero_and_differentiate() -> None:
    logits = torch.tensor([[1.0, 2.0, 3.0], [1e4, -1e4, 0.0], [5.0, 6.0, 7.0]], requires_grad=True)
    mask = torch.tensor([[True, False, True], [True, True, False], [False, False, False]])
    log_probabilities = masked_log_probabilities(logits, mask)
    assert torch.equal(log_probabilities.isneginf(), ~mask)
    assert (log_probabilities.exp()[2] == 0).all()
    torch.testing.assert_close(log_probabilities.exp().sum(dim=1), torch.tensor([1.0, 1.0, 0.0]))
    log_probabilities[mask].sum().backward()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()
    assert (logits.grad[~mask] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_learns_one_answer_by_heart(kind: str, arch: Assembly) -> None:
    """Gradients are finite and lead where they should: a batch of random answers is overfitted."""
    policy = make_policy(arch, settings_of(kind))
    states = torch.unique(random_states(arch, 12), dim=0)
    mask = mask_of(arch, states, robots=9)
    wanted = torch.multinomial(mask.float(), 1, generator=torch.Generator().manual_seed(0))
    success = torch.where(torch.arange(len(states)) % 2 == 0, 0.9, -0.9)
    optimizer = torch.optim.Adam(policy.parameters(), lr=5e-3)
    for _ in range(120):
        logits, value = policy(states)
        loss = -masked_log_probabilities(logits, mask).gather(1, wanted).mean() + (value - success).square().mean()
        optimizer.zero_grad()
        loss.backward()
        for weight in policy.parameters():
            assert weight.grad is not None
            assert weight.grad.isfinite().all()
        optimizer.step()
    logits, value = policy(states)
    assert torch.equal(masked_log_probabilities(logits, mask).argmax(dim=1), wanted[:, 0])
    assert torch.equal(value > 0, success > 0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_target_matters_to_a_policy_of_two_states_only(kind: str, arch: Assembly) -> None:
    states = random_states(arch, 4)
    empty = torch.where(torch.tensor(arch.boundary.tolist()), 2, 0).to(torch.uint8).expand(4, -1)
    other = random_states(arch, 4, seed=5)
    told = make_policy(arch, settings_of(kind, goal_conditioned=True))
    untold = make_policy(arch, settings_of(kind))
    assert torch.equal(told(states)[0], told(states, empty)[0])
    assert not torch.allclose(told(states)[0], told(states, other)[0])
    assert torch.equal(untold(states)[0], untold(states, other)[0])


def test_weights_know_nothing_of_their_structure(arch: Assembly, dome: Assembly) -> None:
    """Weights of one structure load into a policy of another, and shared weights are trained together."""
    policy = make_policy(arch, settings_of("transformer"))
    other = share(policy, dome)
    assert other.part_count == dome.part_count
    ours, theirs = dict(policy.named_parameters()), dict(other.named_parameters())
    assert all(theirs[name] is weight for name, weight in ours.items())
    logits, value = other(random_states(dome, 3))
    (logits.square().sum() + value.sum()).backward()
    assert all(weight.grad is not None for weight in ours.values())


def test_policies_that_know_parts_by_number_do_not_transfer(arch: Assembly, dome: Assembly) -> None:
    settings = settings_of("mlp")
    weights = make_policy(arch, settings).state_dict()
    with pytest.raises(InputError, match="by their number"):
        transfer(weights, settings, dome)


def test_weights_of_other_settings_are_refused(arch: Assembly, dome: Assembly) -> None:
    weights = make_policy(arch, settings_of("transformer")).state_dict()
    with pytest.raises(InputError, match="do not fit the settings"):
        transfer(weights, settings_of("transformer", channels=32), dome)


def test_states_of_another_structure_are_refused(arch: Assembly, dome: Assembly) -> None:
    policy = make_policy(arch, settings_of("transformer"))
    with pytest.raises(InputError, match=f"have {dome.part_count} parts; this policy is for {arch.part_count}"):
        policy(random_states(dome, 2))


def test_describe_counts_the_weights(arch: Assembly) -> None:
    parts = arch.part_count
    about = describe(make_policy(arch, PolicySettings("mlp")), PolicySettings("mlp"))
    assert about["parameters"] == 4 * parts * 64 + 2 * 64 * 64 + 3 * 64 + 64 * 2 * parts + 2 * parts + 65
    assert (about["kind"], about["layers"], about["channels"]) == ("mlp", 3, 64)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "rnn"}, "unknown policy kind 'rnn'; choose resmlp, transformer, local, gat, mlp"),
        ({"layers": -1}, "layers is -1"),
        ({"kind": "transformer", "channels": 30}, "30 do not divide among 8 heads"),
    ],
)
def test_wrong_settings_are_refused(options: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        PolicySettings(**options)


def test_settings_survive_a_file() -> None:
    settings = PolicySettings("gat", goal_conditioned=True, layers=3)
    assert from_dict(PolicySettings, asdict(settings)) == settings
    assert settings.resolved().channels == 16
    with pytest.raises(InputError, match="'depth' is not a setting of PolicySettings"):
        from_dict(PolicySettings, {"depth": 3})


@pytest.mark.parametrize("kind", KINDS)
def test_half_precision_changes_little(kind: str, arch: Assembly) -> None:
    policy = make_policy(arch, settings_of(kind))
    states = random_states(arch, 8)
    logits, value = policy(states)
    with torch.autocast("cpu", torch.bfloat16):
        half_logits, half_value = policy(states)
    assert half_logits.dtype == half_value.dtype == torch.float32
    torch.testing.assert_close(half_logits, logits, atol=0.05, rtol=0.05)
    torch.testing.assert_close(half_value, value, atol=0.05, rtol=0.05)
    (half_logits.sum() + half_value.sum()).backward()
    assert all(weight.grad is not None and weight.grad.isfinite().all() for weight in policy.parameters())


@pytest.mark.parametrize("kind", TRANSFER)
def test_a_compiler_sees_one_piece(kind: str, arch: Assembly) -> None:
    """Nothing in a network makes a compiler fall back to Python."""
    policy = make_policy(arch, settings_of(kind, goal_conditioned=True, layers=1))
    compiled = torch.compile(policy, backend="eager", fullgraph=True)
    states, targets = random_states(arch, 8), random_states(arch, 8, seed=1)
    for one, other in zip(compiled(states, targets), policy(states, targets), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_the_recommended_network_depends_on_what_there_is_to_learn() -> None:
    assert recommended(12) == PolicySettings("resmlp")
    small = PolicySettings("transformer", layers=3, channels=64, heads=4)
    assert recommended(62) == recommended(62, kind="transformer") == small
    goals = PolicySettings("transformer", goal_conditioned=True)
    assert recommended(37, goal_conditioned=True) == recommended(37, goal_conditioned=True, kind="transformer") == goals
    assert recommended(12, kind="transformer") == PolicySettings("transformer")
    assert recommended(12, goal_conditioned=True) == PolicySettings("resmlp", goal_conditioned=True)
    assert recommended(62, goal_conditioned=True, kind="mlp") == PolicySettings("mlp", goal_conditioned=True)
