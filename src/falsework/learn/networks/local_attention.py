"""Local attention over the contact graph: one set of weights for structures of any kind and size.

Each part is a token: its condition in the state, its features in the graph of contacts, and what holds for the whole
structure (robots, criterion, share that is left). In every layer a part attends to its neighbours with a bias and a
value for each pair, made from the features of their contacts; a few pooled tokens, softmax-weighted sums over all
parts, are added to every part. Cost and memory grow linearly with the number of parts.

All features are invariant (`contact_graph`). Directions about the vertical enter by one kind of number: each head adds
up the horizontal lever arms of the neighbours that it attends to, and the length of the sum goes on. So a head that
attends to what still carries a part sees whether it does so from one side only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from falsework.assembly.model import Assembly
from falsework.geometry.arrays import Rows
from falsework.learn.config.policy import EXPANSION, PolicySettings
from falsework.learn.networks.contact_graph import PAIR_FEATURES, PART_FEATURES, WHOLE_FEATURES, ContactGraph
from falsework.learn.networks.policy import Policy, small_head

CONDITIONS = 2
"""Robots and criterion."""
_OF_STATE = 3
"""Robots that are free, as a share and as a question, and the share of parts that is left."""
_POOLED = 4
"""Pooled tokens, which share the channels."""
_HIDDEN = 48
"""Hidden channels of the network for pairs."""
_LOW = -1e4
"""Score of an empty slot: exactly zero after softmax, and finite in half precision."""
_CHUNK_BYTES = {"cpu": 2**23, "cuda": 2**31}
"""Memory for neighbours' tokens of states that are only evaluated; larger batches are split."""


@dataclass(frozen=True, eq=False)
class GraphTensors(Rows):
    """Graphs of several structures, filled up to the same number of parts and of slots."""

    part: Tensor
    """Shape (structures, parts, PART_FEATURES)."""
    neighbour: Tensor
    """Shape (structures, parts, slots), int64."""
    taken: Tensor
    """Shape (structures, parts, slots), bool."""
    pair: Tensor
    """Shape (structures, parts, slots, PAIR_FEATURES)."""
    lever: Tensor
    """Shape (structures, parts, slots, 2)."""
    whole: Tensor
    """Shape (structures, WHOLE_FEATURES)."""
    fixed: Tensor
    """Boundary parts, shape (structures, parts), bool."""
    real: Tensor
    """Parts that exist, shape (structures, parts), bool."""
    conditions: Tensor
    """As of `conditions`, shape (structures, CONDITIONS)."""
    robots: Tensor
    """Shape (structures,)."""

    @staticmethod
    def from_graph(graph: ContactGraph) -> GraphTensors:
        """Put one graph into tensors, for two robots and the criterion `contact`."""
        tensors = [torch.tensor(getattr(graph, entry.name))[None] for entry in fields(graph)]
        part, neighbour, taken, pair, lever, whole, fixed = tensors
        real = torch.ones_like(fixed)
        return GraphTensors(
            part, neighbour, taken, pair, lever, whole, fixed, real, conditions(2, False)[None], torch.tensor([2.0])
        )

    def to(self, device: torch.device | str) -> GraphTensors:
        """Move all tensors."""
        return GraphTensors(*(getattr(self, entry.name).to(device) for entry in fields(self)))

    @staticmethod
    def joined(graphs: Sequence[GraphTensors]) -> GraphTensors:
        """Return the structures of several ones that are filled up alike."""
        return GraphTensors(*(torch.cat([getattr(one, name.name) for one in graphs]) for name in fields(GraphTensors)))


def conditions(robots: int, equilibrium: bool) -> Tensor:
    """Return the number of robots and the criterion as features, shape (CONDITIONS,)."""
    return torch.tensor([float(torch.log2(torch.tensor(float(robots)))) / 2, float(equilibrium)])


class LocalAttentionPolicy(Policy):
    """Local attention over the contact graph of one structure."""

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Make the network and keep the graph of an assembly."""
        super().__init__(assembly, settings)
        graph = GraphTensors.from_graph(ContactGraph.from_assembly(assembly))
        self._names = [entry.name for entry in fields(graph)]
        for name in self._names:
            self.keep(f"graph_{name}", getattr(graph, name))
        self.network = LocalAttention(self.settings)

    def of_task(self, robots: int, *, equilibrium: bool) -> Self:
        """See `Policy.of_task`."""
        buffers = dict(self.named_buffers())
        buffers["graph_conditions"].copy_(conditions(robots, equilibrium)[None])
        buffers["graph_robots"].fill_(float(robots))
        return self

    def forward(self, states: Tensor, targets: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Policy`; batches that need no gradient go in pieces that fit into memory."""
        graph = GraphTensors(*(getattr(self, f"graph_{name}") for name in self._names))
        numbers = self.numbers(states, targets)
        row = 4 * 3 * graph.neighbour[0].numel() * self.settings.channels + 1
        chunk = max(1, _CHUNK_BYTES.get(states.device.type, 2**26) // row)
        whole = torch.is_grad_enabled() or torch.compiler.is_compiling()
        pieces = [numbers] if whole or len(numbers) <= chunk else numbers.split(chunk)
        answers = [self.network(graph, piece[None]) for piece in pieces]
        logits, value = (torch.cat([part[0] for part in column]) for column in zip(*answers, strict=True))
        return logits, value


class LocalAttention(nn.Module):
    """The network without a structure: graphs are part of its input."""

    def __init__(self, settings: PolicySettings) -> None:
        """Make the layers; the settings are resolved."""
        super().__init__()
        channels, layers = settings.channels, settings.layers
        self.goal_conditioned = settings.goal_conditioned
        self.part_in = nn.Sequential(nn.Linear(PART_FEATURES, channels), nn.GELU(), nn.Linear(channels, channels))
        self.state_in = nn.Embedding(12 if settings.goal_conditioned else 4, channels)
        self.whole_in = nn.Sequential(
            nn.Linear(WHOLE_FEATURES + CONDITIONS + _OF_STATE, channels), nn.GELU(), nn.Linear(channels, channels)
        )
        self.pair_in = nn.Sequential(
            nn.Linear(PAIR_FEATURES, _HIDDEN), nn.GELU(), nn.Linear(_HIDDEN, _HIDDEN), nn.GELU()
        )
        self.layers = nn.ModuleList(_Layer(channels, settings.heads, layers) for _ in range(layers))
        self.norm = nn.LayerNorm(channels)
        self.action_head = nn.Sequential(nn.Linear(2 * channels, channels), nn.GELU(), small_head(channels, 2))
        self.value_head = nn.Sequential(nn.Linear(channels, channels), nn.GELU(), small_head(channels, 1))

    def forward(self, graph: GraphTensors, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits and values.

        Args:
            numbers: class of every part as of `Policy.numbers`, shape (structures, states, parts).

        Returns:
            Logits, float32, shape (structures, states, 2 parts); values in [-1, 1], shape (structures, states).
        """
        dtype = self.norm.weight.dtype
        x = self.state_in(numbers.long()) + self.part_in(graph.part.to(dtype))[:, None]
        x = x + self.whole_in(self._whole(graph, numbers).to(dtype))[:, :, None]
        pair = self.pair_in(graph.pair.to(dtype))
        for layer in self.layers:
            x = layer(x, pair, graph)
        x = self.norm(x)
        weight = graph.real.to(x.dtype)[:, None, :, None]
        mean = (x * weight).sum(dim=2) / weight.sum(dim=2)
        logits = self.action_head(torch.cat([x, mean[:, :, None].expand_as(x)], dim=-1))
        value = self.value_head(mean).float()
        return logits.float().transpose(2, 3).flatten(2), torch.tanh(value).squeeze(-1)

    def _whole(self, graph: GraphTensors, numbers: Tensor) -> Tensor:
        """Return the features of structure, task and state, shape (structures, states, features)."""
        condition = torch.div(numbers, 3, rounding_mode="floor") if self.goal_conditioned else numbers
        loose = (graph.real & ~graph.fixed)[:, None]
        held = ((condition == 2) & loose).sum(dim=2)
        left = ((condition != 0) & loose).sum(dim=2) / loose.sum(dim=2).clamp(min=1)
        free = 1.0 - held / graph.robots[:, None]
        of_state = torch.stack([free, (free > 0).to(free.dtype), left], dim=2)
        fixed = torch.cat([graph.whole, graph.conditions], dim=1)[:, None].expand(-1, numbers.shape[1], -1)
        return torch.cat([fixed.to(of_state.dtype), of_state], dim=2)


class _Layer(nn.Module):
    """Attention to neighbours, pooled tokens and a feed-forward layer, with pre-normalisation and residuals."""

    def __init__(self, channels: int, heads: int, layers: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_in = nn.LayerNorm(channels)
        self.into = nn.Linear(channels, 4 * channels)
        self.bias = nn.Linear(_HIDDEN, heads)
        self.pair_value = nn.Linear(_HIDDEN, channels, bias=False)
        self.pool = nn.Linear(channels, _POOLED)
        self.out = nn.Linear(channels + heads, channels)
        self.pooled_out = nn.Linear(channels, channels)
        self.norm_up = nn.LayerNorm(channels)
        self.up = nn.Linear(channels, EXPANSION * channels)
        self.down = nn.Linear(EXPANSION * channels, channels)
        for last in (self.out, self.pooled_out, self.down):
            nn.init.normal_(last.weight, std=0.5 / (channels * layers) ** 0.5)

    def forward(self, x: Tensor, pair: Tensor, graph: GraphTensors) -> Tensor:
        structures, states, parts, _ = x.shape
        slots = graph.neighbour.shape[2]
        h = self.norm_in(x)
        query, key, value, summed = self.into(h).chunk(4, dim=-1)
        near = _neighbours(torch.cat([key, value], dim=-1), graph.neighbour)
        key, value = near.view(structures, states, parts, slots, 2, self.heads, -1).unbind(dim=4)
        query = query.view(structures, states, parts, 1, self.heads, -1)
        bias = self.bias(pair).masked_fill(~graph.taken[..., None], _LOW)[:, None]
        weight = (((query * key).sum(dim=-1) * key.shape[-1] ** -0.5).float() + bias.float()).softmax(dim=3)
        weight = (weight * graph.taken[:, None, ..., None]).to(x.dtype)
        mixed = (weight.to(value.dtype)[..., None] * value).sum(dim=3)
        # What the contacts themselves say, weighted by the same attention.
        said = self.pair_value(pair).view(structures, parts, slots, self.heads, -1)
        mixed = (mixed + torch.einsum("msikh,mikhc->msihc", weight, said)).flatten(3)
        moment = torch.einsum("msikh,mikd->msihd", weight.float(), graph.lever)
        moment = (moment.square().sum(dim=-1) + 1e-4).sqrt().to(x.dtype)
        pooled = self._pooled(h, summed, graph.real)
        x = x + self.out(torch.cat([mixed, moment], dim=-1)) + self.pooled_out(pooled)[:, :, None]
        return x + self.down(gelu(self.up(self.norm_up(x))))

    def _pooled(self, h: Tensor, summed: Tensor, real: Tensor) -> Tensor:
        """Return the pooled tokens, one after another, shape (structures, states, channels)."""
        score = self.pool(h).float().masked_fill(~real[:, None, :, None], _LOW)
        weight = score.softmax(dim=2).to(summed.dtype)
        each = summed.unflatten(-1, (_POOLED, -1))
        return torch.einsum("msig,msigc->msgc", weight, each).flatten(2)


def _neighbours(x: Tensor, neighbour: Tensor) -> Tensor:
    """Return the tokens of the neighbours, shape (structures, states, parts * slots, channels)."""
    if len(neighbour) == 1:
        return x.index_select(2, neighbour.flatten())
    index = neighbour.flatten(1)[:, None, :, None].expand(-1, x.shape[1], -1, x.shape[3])
    return x.gather(2, index)
