"""Attention on the force-torque graph: the network of the paper (section 5.4).

In every layer each node takes, along each kind of edge, an attention-weighted mean of its neighbours, and sums over the
kinds. The weight of neighbour `j` of node `i` is the softmax over the neighbours of `LeakyReLU(s_j + d_i)`, with `s`
and `d` linear in the features (graph attention; the product of its vector and matrix is learned as one).

It is fast because little of that is attention. A torque has one part, one force and one partner, and a force
has one part on either side: softmax over one neighbour is 1, so these are plain products of matrices. Real attention is
needed into forces (from torques) and into parts (from torques, forces of either kind, and parts). Torques lie on a grid
of rows, each of one force, so that sums over torques are sums over axes; rows and parts, some hundred of them, meet in
products with constant 0-1 matrices, which unlike scattered additions give the same bits every time. Means are taken
before they are multiplied by weights, which is the same and keeps the wide arrays few. A state only masks nodes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import elu, leaky_relu

from falsework.assembly.model import Assembly
from falsework.learn.config.policy import PolicySettings
from falsework.learn.networks.force_torque_graph import ForceTorqueGraph
from falsework.learn.networks.policy import Policy, small_head

_SLOPE = 0.2
"""Of LeakyReLU below zero, as usual for graph attention."""
_CHUNK_BYTES = {"cpu": 2**26, "cuda": 2**30}
"""Memory for the features of torques of states that are only evaluated; larger batches are split."""


class GraphAttentionPolicy(Policy):
    """Graph attention over parts, forces and torques."""

    mass: Tensor
    normals: Tensor
    levers: Tensor

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Build the graph of an assembly and make the network."""
        super().__init__(assembly, settings)
        sizes = self.settings
        graph = ForceTorqueGraph.from_assembly(assembly)
        self.topology = _Topology(graph)
        self.keep("mass", torch.tensor(graph.mass))
        self.keep("normals", torch.tensor(graph.normals))
        self.keep("levers", torch.tensor(graph.grid().levers))
        # Held, in the target and mass; a policy that knows a target must also know which parts end up held in it.
        self.part_in = nn.Linear(4 if sizes.goal_conditioned else 3, sizes.channels)
        self.force_in = nn.Linear(3, sizes.channels)
        self.torque_in = nn.Linear(3, sizes.channels)
        self.layers = nn.ModuleList(
            Layer(sizes.channels, sizes.heads, last=layer == sizes.layers - 1) for layer in range(sizes.layers)
        )
        self.norm = Norm(sizes.channels)
        self.action_hidden = nn.Linear(sizes.channels, sizes.channels)
        self.action_head = small_head(sizes.channels, 2)
        self.value_hidden = nn.Linear(sizes.channels, sizes.channels)
        self.value_head = small_head(sizes.channels, 1)

    def forward(self, states: Tensor, targets: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Policy`; batches that need no gradient go in pieces that fit into memory."""
        kinds = self.numbers(states, targets)
        chunk = max(
            1, _CHUNK_BYTES[states.device.type] // (4 * self.levers[..., 0].numel() * self.settings.channels + 1)
        )
        if torch.is_grad_enabled() or len(states) <= chunk or torch.compiler.is_compiling():
            return self._evaluate(kinds)
        pieces = [self._evaluate(piece) for piece in kinds.split(chunk)]
        return torch.cat([logits for logits, _ in pieces]), torch.cat([value for _, value in pieces])

    def _evaluate(self, kinds: Tensor) -> tuple[Tensor, Tensor]:
        features, present = self.part_inputs(kinds)
        # Broadcast over the batch until the first layer brings in the state.
        part = self.part_in(features)
        force = self.force_in(self.normals)[None]
        torque = self.torque_in(self.levers)[None]
        there = self.topology.masks(present)
        for layer in self.layers:
            part, force, torque = layer(part, force, torque, self.topology, there)
        part = self.norm(part)
        logits = self.action_head(elu(self.action_hidden(part))).float()
        logits = torch.where(present[..., None], logits, 0.0).transpose(1, 2).flatten(1)
        mean = torch.where(present[..., None], part, 0.0).sum(dim=1) / present.sum(dim=1, keepdim=True)
        value = self.value_head(elu(self.value_hidden(mean.to(part.dtype)))).float()
        return logits, torch.tanh(value).squeeze(-1)

    def part_inputs(self, kinds: Tensor) -> tuple[Tensor, Tensor]:
        """Return features of part nodes, shape (batch, parts, 3 or 4), and their presence, shape (batch, parts)."""
        if self.settings.goal_conditioned:
            state, goal = kinds // 3, kinds % 3
            flags = [state >= 2, goal >= 1, goal == 2]
        else:
            state = kinds
            flags = [state >= 2, self.fixed.expand_as(state)]
        mass = self.mass.expand(state.shape)
        return torch.stack([*(flag.to(mass.dtype) for flag in flags), mass], dim=-1), state != 0


class _Topology(nn.Module):
    """Incidence of rows of torques, forces and parts, as constant 0-1 matrices and as indices."""

    row_part: Tensor
    """Shape (2 rows, parts): part of each side of a row."""
    row_force: Tensor
    """Shape (rows, forces)."""
    out_of: Tensor
    """Shape (forces, parts): the part that the normal points out of."""
    into: Tensor
    """Shape (forces, parts): the part that the normal points into."""
    taken: Tensor
    """Shape (rows, 1, slots, 1), bool: slots that are torque nodes."""
    others: Tensor
    """Shape (parts, parts), bool: all but the part itself."""

    def __init__(self, graph: ForceTorqueGraph) -> None:
        super().__init__()
        grid = graph.grid()
        ends = torch.from_numpy(graph.force_parts.astype("int64"))
        force = torch.from_numpy(grid.force)
        numbers = {"row_part": ends[force].flatten(), "row_force": force, "out_of": ends[:, 0], "into": ends[:, 1]}
        for name, number in numbers.items():
            count = graph.force_count if name == "row_force" else graph.part_count
            matrix = (number[:, None] == torch.arange(count)).float()
            self.register_buffer(name, matrix, persistent=False)
            self.register_buffer(f"{name}_number", number.contiguous(), persistent=False)
        self.register_buffer("taken", torch.from_numpy(grid.taken)[:, None, :, None], persistent=False)
        self.register_buffer("others", ~torch.eye(graph.part_count, dtype=torch.bool), persistent=False)

    def masks(self, present: Tensor) -> _There:
        """Return which nodes are present, from the presence of parts, shape (batch, parts)."""
        absent = (~present).to(self.into.dtype)[..., None]
        force = ((self.into + self.out_of) @ absent) == 0
        row = (self.row_force @ force.to(self.into.dtype)) > 0.5
        return _There(present, force, row[:, :, None, None] & self.taken)

    def attention(
        self, relation: str, says: Tensor, asks: Tensor, features: Tensor, there: Tensor, matrix: Tensor
    ) -> Tensor:
        """Return the attention-weighted messages to nodes with several neighbours.

        Args:
            relation: `row_part`, `row_force`, `out_of` or `into`.
            says: part of a score that depends on the sender, shape (batch, rows or forces, ..., heads).
            asks: part that depends on the receiver, shape (batch, receivers, heads).
            features: of the senders, shape (batch, rows or forces, ..., channels).
            there: which senders are present, shape (batch, rows or forces, ..., 1).
            matrix: linear map of the mean, shape (heads, channels, channels / heads).

        Returns:
            Shape (batch, receivers, channels); zero for a receiver without senders.
        """
        belongs, number = getattr(self, relation).to(features.dtype), getattr(self, f"{relation}_number")
        heads, channels, _ = matrix.shape
        inner = [1] * (says.dim() - 3)
        score = leaky_relu(says + (belongs @ asks).unflatten(1, (-1, *inner)), _SLOPE).float()
        count = score.shape[1]

        # The largest score at each receiver is taken off before exponentiation; it needs no gradient.
        high = torch.where(there, score, -1e30).detach()
        if inner:
            high = high.flatten(2, -2).amax(dim=2)
        where = number[None, :, None].expand(len(high), count, heads)
        top = torch.full((len(high), belongs.shape[1], heads), -1e30, dtype=score.dtype, device=score.device)
        top = top.scatter_reduce(1, where, high, "amax").gather(1, where).unflatten(1, (count, *inner))
        weight = (torch.exp(torch.clamp(score - top, max=0.0)) * there).to(features.dtype)

        message = weight[..., None] * features[..., None, :]
        if inner:
            weight, message = weight.flatten(2, -2).sum(dim=2), message.flatten(2, -3).sum(dim=2)
        gathered = belongs.T @ torch.cat([weight, message.flatten(2)], dim=2)
        total, message = gathered[..., :heads], gathered[..., heads:].unflatten(-1, (heads, channels))
        mean = message / torch.where(total > 0, total, 1.0)[..., None]
        return torch.einsum("bnhc,hcd->bnhd", mean, matrix).flatten(2)


class _There:
    """Nodes of a batch of states: part (batch, parts), force (batch, forces, 1), torque (batch, rows, 1, slots, 1)."""

    def __init__(self, part: Tensor, force: Tensor, torque: Tensor) -> None:
        self.part, self.force, self.torque = part, force, torque


class Norm(nn.LayerNorm):
    """Layer norm over few channels.

    On a GPU, torch gives every row a block of threads of its own and goes to float32 and back. With 16 channels and two
    thousand rows a state that was half of all time; sums as products with a constant matrix are a tenth of it.
    """

    def forward(self, input: Tensor) -> Tensor:
        """See `LayerNorm`."""
        return super().forward(input) if input.device.type == "cpu" else self.by_products(input)

    def by_products(self, features: Tensor) -> Tensor:
        """Return the same in the type of the features."""
        count = features.shape[-1]
        mean = features.new_full((count, count), 1.0 / count)
        off = features - features @ mean
        scale = torch.rsqrt((off * off) @ mean + self.eps)
        return off * scale * self.weight.to(features.dtype) + self.bias.to(features.dtype)


class Layer(nn.Module):
    """One round of message passing along all kinds of edges, with pre-normalisation and a residual connection."""

    def __init__(self, channels: int, heads: int, last: bool) -> None:
        super().__init__()
        c, h = channels, heads
        self.heads = heads
        self.norm_part, self.norm_force, self.norm_torque = (Norm(c) for _ in range(3))
        # Self loop, with the bias of the node; then the sender and receiver terms of the attention scores, and the
        # linear # map of the mean, head by head.
        self.part_self = nn.Linear(c, c)
        self.torque_sends = nn.Linear(c, h if last else 2 * h, bias=False)
        self.force_sends = nn.Linear(c, 2 * h, bias=False)
        self.part_sends = nn.Linear(c, h, bias=False)
        self.part_asks = nn.Linear(c, 4 * h, bias=False)
        self.torque_to_part, self.out_to_part, self.into_to_part, self.part_to_part = (_matrix(h, c) for _ in range(4))
        self.inward = None if last else _Inward(c, h)

    def forward(
        self, part: Tensor, force: Tensor, torque: Tensor, topology: _Topology, there: _There
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the features after one exchange between parts, forces and torques."""
        h = self.heads
        p, f, t = self.norm_part(part), self.norm_force(force), self.norm_torque(torque)
        torque_says, force_says, asks = self.torque_sends(t), self.force_sends(f), self.part_asks(p)
        sides = (t.shape[0], 2 * t.shape[1], 1, *t.shape[3:])  # a side of a row belongs to one part
        says, features = torque_says[..., :h].reshape(*sides[:-1], h), t.reshape(sides)
        present = there.torque.expand(-1, -1, 2, -1, -1).reshape(len(there.torque), *sides[1:-1], 1)
        change = self.part_self(p)
        change = change + topology.attention("row_part", says, asks[..., :h], features, present, self.torque_to_part)
        for kind, name, matrix in ((1, "out_of", self.out_to_part), (2, "into", self.into_to_part)):
            says, asked = force_says[..., (kind - 1) * h : kind * h], asks[..., kind * h : (kind + 1) * h]
            change = change + topology.attention(name, says, asked, f, there.force, matrix)
        change = change + self._between_parts(p, asks[..., 3 * h :], topology, there)
        if self.inward is not None:
            force, torque = self.inward(force, torque, (p, f, t), torque_says[..., h:], topology, there)
        return part + elu(change), force, torque

    def _between_parts(self, p: Tensor, asks: Tensor, topology: _Topology, there: _There) -> Tensor:
        """Compute the attention of every part to all other present parts."""
        says = self.part_sends(p).transpose(1, 2)
        score = leaky_relu(says[:, :, None, :] + asks.transpose(1, 2)[..., None], _SLOPE).float()
        seen = there.part[:, None, None, :] & topology.others
        weight = torch.softmax(torch.where(seen, score, -1e30), dim=-1) * seen
        mean = weight.to(p.dtype) @ p[:, None]
        return torch.einsum("bhic,hcd->bihd", mean, self.part_to_part).flatten(2)


class _Inward(nn.Module):
    """The half of a layer with messages into forces and torques, which the last layer does not need."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        c = channels
        self.force_self = nn.Linear(c, c)
        self.torque_self = nn.Linear(c, c)
        # Along edges with one neighbour.
        self.torque_to_torque, self.part_to_torque, self.force_to_torque, self.out_to_force, self.into_to_force = (
            nn.Linear(c, c, bias=False) for _ in range(5)
        )
        self.force_asks = nn.Linear(c, heads, bias=False)
        self.torque_to_force = _matrix(heads, c)

    def forward(
        self,
        force: Tensor,
        torque: Tensor,
        normed: tuple[Tensor, Tensor, Tensor],
        torque_says: Tensor,
        topology: _Topology,
        there: _There,
    ) -> tuple[Tensor, Tensor]:
        p, f, t = normed
        rows = len(topology.taken)
        about = (topology.row_part.to(p.dtype) @ self.part_to_torque(p)).unflatten(1, (rows, 2))[:, :, :, None]
        of = (topology.row_force.to(p.dtype) @ self.force_to_torque(f))[:, :, None, None]
        torque = torque + elu(self.torque_self(t) + self.torque_to_torque(t.flip(2)) + about + of)
        change = self.force_self(f) + topology.attention(
            "row_force", torque_says, self.force_asks(f), t, there.torque, self.torque_to_force
        )
        change = change + topology.out_of.to(p.dtype) @ self.out_to_force(p)
        change = change + topology.into.to(p.dtype) @ self.into_to_force(p)
        return force + elu(change), torque


def _matrix(heads: int, channels: int) -> nn.Parameter:
    return nn.Parameter(torch.empty(heads, channels, channels // heads).uniform_(-1, 1) / channels**0.5)
