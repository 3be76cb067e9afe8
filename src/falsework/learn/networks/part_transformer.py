"""Transformer over the parts of a structure: the default network above 20 parts, and for transfer.

Each part is a token: its condition in the state (removed, installed, held, boundary; by its value in the target), the
share of its contacts with neighbours in each condition, and its own geometry. Parts attend to each other with a bias
for each pair that a small network makes from the geometry of the pair (offset, contact, normal, area, hops in the
contact graph). No input identifies a part by number, so the network is equivariant to renumbering parts, invariant to
translation and to the unit of length, and its weights fit any structure. Removed parts remain as tokens, since gaps are
informative.

The bias depends on the structure and the weights alone, so one array of shape (heads, parts, parts) serves the whole
batch, and there are no masks by state: every layer is four products of matrices and one fused attention.

Cost, for `L` layers, `m` parts, `c` channels and `e c` hidden ones: `L (2 m c^2 (4 + 2 e) + 4 m^2 c)` operations a
state forward, three times that with the backward pass. For 62 parts, 4 layers, 128 channels, `e = 2`: 73 and 219 MFLOP.
200,000 states a second are then 44 TFLOP/s, a twentieth of what an H200 does in bfloat16. The bottleneck is memory
bandwidth: some 75 passes over the activations of a token in each layer, forward and backward together, are 62 x 128 x 2
byte x 75 x 4 = 4.8 MB a state, of which 4.8 TB/s carry a million a second at the very best.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.functional import gelu, pad, scaled_dot_product_attention

from falsework.assembly.model import Assembly
from falsework.learn.config.policy import EXPANSION, PolicySettings
from falsework.learn.networks.geometric_features import PAIR_FEATURES, PART_FEATURES, PORTS, PartFeatures
from falsework.learn.networks.policy import Policy, small_head


class PartTransformerPolicy(Policy):
    """Transformer over parts with an attention bias from the geometry of pairs."""

    part_features: Tensor
    pair_features: Tensor
    ports: Tensor

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Make the network and keep the geometry of an assembly."""
        super().__init__(assembly, settings)
        sizes = self.settings
        channels = sizes.channels
        features = PartFeatures.from_assembly(assembly)
        self.keep("part_features", torch.tensor(features.part))
        self.keep("pair_features", torch.tensor(features.pair))
        self.keep("ports", torch.tensor(features.ports))
        self.state_in = nn.Linear(self.kinds_of_part * (1 + PORTS), channels)
        self.part_in = nn.Sequential(nn.Linear(PART_FEATURES, channels), nn.GELU(), nn.Linear(channels, channels))
        self.bias_net = nn.Sequential(
            nn.Linear(PAIR_FEATURES, 64), nn.GELU(), nn.Linear(64, sizes.layers * sizes.heads)
        )
        blocks = [_Block(channels, sizes) for _ in range(sizes.layers)]
        self.blocks = nn.ModuleList(blocks)
        self.norm = nn.LayerNorm(channels)
        self.action_head = small_head(channels, 2)
        self.value_hidden = nn.Linear(channels, channels)
        self.value_head = small_head(channels, 1)
        for block in blocks:
            for last in (block.out, block.down):
                nn.init.normal_(last.weight, std=0.5 / (channels * sizes.layers) ** 0.5)

    def forward(self, states: Tensor, targets: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Policy`."""
        sizes = self.settings
        batch, parts = states.shape
        kinds = self.classes(states, targets).to(self.ports.dtype)
        around = torch.einsum("kij,bjs->biks", self.ports, kinds).flatten(2)
        x = self.state_in(torch.cat([kinds, around.to(kinds.dtype)], dim=2))
        shape = self.part_in(self.part_features)
        x = x + shape.to(x.dtype)
        bias = self.bias_net(self.pair_features).to(x.dtype).permute(2, 0, 1)
        # Fused attention wants rows that lie together and begin at multiples of 16 bytes; the padding is sliced off.
        bias = pad(bias, (0, -parts % 8)).contiguous()[..., :parts]
        with _attention_for_any_batch(x):
            for block, one in zip(self.blocks, bias.unflatten(0, (sizes.layers, 1, sizes.heads)), strict=True):
                x = block(x, one)
        x = self.norm(x)
        logits = self.action_head(x).float().transpose(1, 2).reshape(batch, 2 * parts)
        value = self.value_head(gelu(self.value_hidden(x.mean(dim=1)))).float()
        return logits, torch.tanh(value).squeeze(-1)


def _attention_for_any_batch(x: Tensor) -> AbstractContextManager[object]:
    """Select attention kernels for batches of any size, as in rollouts that end one by one.

    On a GPU the first choice of torch is cuDNN, which makes a plan for every new size of batch: 40 ms, of which a
    rollout would wait at each of its steps. Training batches have one size, so cuDNN may be chosen there.
    """
    if not x.is_cuda or torch.is_grad_enabled():
        return nullcontext()
    return sdpa_kernel([SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH])


class _Block(nn.Module):
    """Attention and a feed-forward layer, each with pre-normalisation and a residual connection."""

    def __init__(self, channels: int, sizes: PolicySettings) -> None:
        super().__init__()
        self.heads = sizes.heads
        self.norm_attention = nn.LayerNorm(channels)
        self.into = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)
        self.norm_up = nn.LayerNorm(channels)
        self.up = nn.Linear(channels, EXPANSION * channels)
        self.down = nn.Linear(EXPANSION * channels, channels)

    def forward(self, x: Tensor, bias: Tensor) -> Tensor:
        batch, parts, channels = x.shape
        split = self.into(self.norm_attention(x)).view(batch, parts, 3, self.heads, channels // self.heads)
        query, key, value = split.permute(2, 0, 3, 1, 4)
        mixed = scaled_dot_product_attention(query, key, value, attn_mask=bias.to(query.dtype))
        x = x + self.out(mixed.transpose(1, 2).reshape(batch, parts, channels))
        return x + self.down(gelu(self.up(self.norm_up(x))))
