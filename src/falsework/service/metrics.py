"""Prometheus metrics of the service."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0)
"""Upper ends of the buckets of times, seconds."""
_SIZES = (1, 2, 4, 8, 16, 32, 64)
"""Upper ends of the buckets of batch sizes, requests."""
PATHS = frozenset(
    {"/", "/docs", "/openapi.json", "/replan", "/stability", "/picture", "/structure", "/health", "/metrics"}
)
"""Paths that are counted by name; all others together, so that requests cannot fill the memory with names."""


class Metrics:
    """Counters of one service."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        names = {"registry": self._registry, "namespace": "falsework"}
        self._requests = Counter("requests", "Answers by path and status", ("path", "status"), **names)
        self._seconds = Histogram("request_seconds", "Time to answer", ("path",), buckets=_SECONDS, **names)
        self.answers = Counter("answers", "Answers of workers by who decided", ("kind", "decided_by"), **names)
        self.batch = Histogram("batch_size", "Requests worked on together", ("kind",), buckets=_SIZES, **names)
        self.late = Counter("late", "Requests that got 'not yet' at their deadline", ("kind",), **names)
        self.turned_away = Counter("turned_away", "Requests that found the queue full", **names)
        self.restarts = Counter("worker_restarts", "Workers that were lost and replaced", ("kind",), **names)
        self._queue = Gauge("queue_length", "Requests that wait", **names)
        self.workers = Gauge("workers_ready", "Workers that take requests", **names)

    def answered(self, path: str, status: int, seconds: float) -> None:
        """Count an answered request."""
        name = path if path in PATHS else "other"
        self._requests.labels(name, str(status)).inc()
        self._seconds.labels(name).observe(seconds)

    def text(self, queue: int, workers: int) -> bytes:
        """Return all metrics in the text format of Prometheus."""
        self._queue.set(queue)
        self.workers.set(workers)
        return generate_latest(self._registry)
