"""Processes that evaluate a network for many others: what several of them ask at once goes in one batch.

On a processor, the network takes many times as long as the verdicts on the states that its actions lead to.
"""

from __future__ import annotations

import multiprocessing
import time
from collections import defaultdict
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, cast

import numpy as np
import torch
from experiments.structure_batches import filled
from numpy.typing import NDArray
from torch import nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from falsework.learn.config.policy import PolicySettings
from falsework.learn.networks.contact_graph import ContactGraph
from falsework.learn.networks.local_attention import GraphTensors, LocalAttention
from falsework.stability.verdict import Criterion

_SIZES, _SLOTS = (40, 160, 512, 1 << 16), 16
"""Largest numbers of parts of structures that are filled up to the same size, to be evaluated together, and fewest
neighbours: the time goes by the number of batches."""
_SERVED = 9
"""Processes that one process answers, at most."""
_ROWS = 64
"""States of one structure that are evaluated together."""
_REFRESH = 0.5
"""Seconds between two times that new weights are taken."""


class RemotePolicy:
    """Policy for one structure after another, whose network another process evaluates."""

    def __init__(self, connection: Connection) -> None:
        """Ask through a connection, one of `Inference.connections`."""
        self._connection = connection

    def of(self, graph: ContactGraph, robots: int, criterion: Criterion, *, averaged: bool = False) -> RemotePolicy:
        """Turn to another structure and task, and take the weights as they are, or their average."""
        self._parts = graph.part_count
        self._connection.send((graph, robots, criterion, averaged))
        return self

    def __call__(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """See `falsework.learn.PolicyFunction`."""
        pieces = []
        for piece in states.split(_ROWS):
            self._connection.send(piece.numpy())
            pieces.append(self._connection.recv())
        logits, values = (np.concatenate(column) for column in zip(*pieces, strict=True))
        return torch.from_numpy(logits), torch.from_numpy(values)


class Inference:
    """Processes that evaluate a network on one device, and the ways to them."""

    def __init__(self, network: nn.Module, settings: PolicySettings, count: int, device: torch.device) -> None:
        """Start the processes.

        Args:
            network: of kind `local`, whose weights they begin with.
            settings: of the network, resolved.
            count: processes that will ask.
            device: of the network.
        """
        context = multiprocessing.get_context("spawn")
        size = len(parameters_to_vector(network.parameters()))
        shared = context.RawArray("f", 2 * size)
        self._weights = torch.frombuffer(shared, dtype=torch.float32).view(2, size)
        self.send(network, network)
        ours, self.connections = zip(*(context.Pipe() for _ in range(count)), strict=True)
        self._processes = [
            context.Process(
                target=_serve, args=(ours[begin : begin + _SERVED], shared, settings, str(device)), daemon=True
            )
            for begin in range(0, count, _SERVED)
        ]
        for process in self._processes:
            process.start()

    def send(self, network: nn.Module, averaged: nn.Module) -> None:
        """Let them go on with new weights, as they are and averaged."""
        for row, one in zip(self._weights, (network, averaged), strict=True):
            row.copy_(parameters_to_vector(one.parameters()).detach())

    def close(self) -> None:
        """End the processes."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()


def _serve(connections: Sequence[Connection], shared: Any, settings: PolicySettings, place: str) -> None:
    """Answer until no process is left that asks."""
    device = torch.device(place)
    torch.set_num_threads(1)
    weights = torch.frombuffer(shared, dtype=torch.float32).view(2, -1)
    networks = [LocalAttention(settings).to(device).eval() for _ in weights]
    known: dict[Connection, tuple[tuple[bool, int, int], GraphTensors]] = {}
    left, refreshed = set(connections), -_REFRESH
    while left:
        asked: dict[tuple[bool, int, int], list[tuple[Connection, NDArray[np.uint8]]]] = defaultdict(list)
        for connection in cast(list[Connection], wait(left)):
            try:
                message = connection.recv()
            except (EOFError, OSError):
                left.discard(connection)
                continue
            if isinstance(message, tuple):
                known[connection] = _placed(message, device)
            else:
                asked[known[connection][0]].append((connection, message))
        if time.perf_counter() - refreshed > _REFRESH:
            for network, row in zip(networks, weights, strict=True):
                vector_to_parameters(row.to(device), network.parameters())
            refreshed = time.perf_counter()
        for (averaged, parts, _), batch in asked.items():
            graph = GraphTensors.joined([known[connection][1] for connection, _ in batch])
            states = np.zeros((len(batch), max(len(one) for _, one in batch), parts), dtype=np.uint8)
            for row, (_, one) in zip(states, batch, strict=True):
                row[: len(one), : one.shape[1]] = one
            logits, values = _evaluate(networks[averaged], graph, torch.from_numpy(states).to(device))
            for (connection, one), row, value in zip(batch, logits, values, strict=True):
                own = row.reshape(len(row), 2, parts)[: len(one), :, : one.shape[1]]
                connection.send((own.reshape(len(one), -1), value[: len(one)]))


def _placed(
    asked: tuple[ContactGraph, int, Criterion, bool], device: torch.device
) -> tuple[tuple[bool, int, int], GraphTensors]:
    """Return the size that a structure is filled up to, and its graph of that size."""
    graph, robots, criterion, averaged = asked
    slots = max(graph.taken.shape[1], _SLOTS)
    parts = next(size for size in _SIZES if graph.part_count <= size)
    return (averaged, parts, slots), filled([(graph, robots, criterion)], parts, slots, device)


@torch.no_grad()
def _evaluate(network: LocalAttention, graph: GraphTensors, states: torch.Tensor) -> list[NDArray[np.float32]]:
    """Return logits and values of states of several structures, shape (structures, states, ...)."""
    numbers = torch.where(graph.fixed[:, None], 3, states.int())
    with torch.autocast(states.device.type, torch.bfloat16, enabled=states.device.type == "cuda"):
        return [one.float().cpu().numpy() for one in network(graph, numbers)]
