# SPDX-License-Identifier: Apache-2.0
"""Every thread of the tracker.

Results are taken over at counted frames and not when they happen to be ready, so a run does not
depend on how fast the threads were.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import ParamSpec, TypeVar

from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.gravity_consensus import GravityConsensus
from slamdepth.stopwatch import Stopwatch
from slamdepth.thread_limits import one_thread_here, single_threaded
from slamdepth.types import DepthPrediction, Frame
from slamdepth.typing import Floats

log = logging.getLogger(__name__)

_P = ParamSpec("_P")
_S = TypeVar("_S")
_T = TypeVar("_T")


class Worker:
    """One thread that computes in the order it was asked.

    A function given to it must read nothing that the tracker changes meanwhile.

    Args:
        name: shown by tools that list threads.
    """

    def __init__(self, name: str) -> None:
        self._pool = ThreadPoolExecutor(1, f"slamdepth-{name}")

    def submit(self, function: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Start ``function``; ``result()`` waits for it and raises what it raised."""
        return self._pool.submit(_single_threaded, partial(function, *args, **kwargs))

    def close(self) -> None:
        """End the thread; work that has not started is dropped."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def ready(result: _T) -> Future[_T]:
    """What a worker would have given, known already: a checkpoint had it."""
    future: Future[_T] = Future()
    future.set_result(result)
    return future


class BetweenFrames(Worker):
    """Changes the map after a frame was answered and before the next one looks at the map.

    One task at a time. The result is as if the task were done at the beginning of the next frame.
    """

    def __init__(self) -> None:
        super().__init__("between")
        self._task: Future[object] | None = None

    def begin(self, task: Callable[[], object]) -> None:
        """Start ``task``; the one before has been waited for."""
        assert self._task is None
        self._task = self.submit(task)

    def wait(self) -> None:
        """Wait for the task, if there is one, and raise what it raised."""
        task, self._task = self._task, None
        if task is not None:
            task.result()

    def close(self) -> None:
        """End the thread; an error of a task that nobody waited for is logged."""
        super().close()
        task, self._task = self._task, None
        if task is not None and not task.cancelled() and (error := task.exception()) is not None:
            log.error("the work between two frames failed: %s", error)


@dataclass(frozen=True)
class GravityInMap:
    """What is known of gravity in a map, and how a camera ``R_world_camera (3, 3)`` is turned in it."""

    consensus: GravityConsensus
    R_world_camera: Floats


class DepthWorker:
    """Predicts the depth of keyframes, one after the other, in a thread that computes on one core.

    A sensor's depth is there already and is passed on at once. What one image of a map says of gravity helps
    to predict the next.

    Args:
        with_uncertainty: False drops what a network says of its errors.
        watch: measures the waiting, as ``depth``.
    """

    def __init__(self, model: DepthModel, watch: Stopwatch, *, with_uncertainty: bool = True) -> None:
        self._model = model
        self._is_sensor = is_sensor(model)
        self._watch = watch
        self._with_uncertainty = with_uncertainty
        self._pool = ThreadPoolExecutor(1, "slamdepth-depth", initializer=one_thread_here)
        self._requested: list[tuple[Frame, Future[DepthPrediction]]] = []
        self._last: tuple[Frame, DepthPrediction] | None = None

    def has_depth(self, frame: Frame) -> bool:
        """A sensor may have no depth for a frame; a network always has."""
        return not self._is_sensor or frame.depth_m is not None

    def is_instant(self, frame: Frame) -> bool:
        """Whether the depth of ``frame`` costs no wait: a sensor's, or the last one taken."""
        return self._is_sensor or self._is_last(frame)

    def _is_last(self, frame: Frame) -> bool:
        return self._last is not None and self._last[0] is frame

    def request(self, frame: Frame, gravity: GravityInMap | None = None) -> None:
        """Start the prediction for ``frame``, unless it was requested before.

        Args:
            gravity: passes the direction of gravity from image to image; None where the pose is not known.
        """
        if not self._is_last(frame) and all(requested is not frame for requested, _ in self._requested):
            self._requested.append((frame, self._pool.submit(self._predict, frame, gravity)))

    def requested(self, frame: Frame) -> DepthPrediction:
        """The prediction that was requested for ``frame`` and not taken yet; waits for it."""
        if self._last is not None and self._last[0] is frame:
            return self._last[1]
        futures = (future for requested, future in self._requested if requested is frame)
        return (next(futures, None) or self._pool.submit(self._predict, frame, None)).result()

    def restore(self, frame: Frame, prediction: DepthPrediction) -> None:
        """As if ``frame`` had been requested, and predicted."""
        self._requested.append((frame, ready(prediction)))

    def _predict(self, frame: Frame, gravity: GravityInMap | None) -> DepthPrediction:
        if gravity is None or frame.gravity is not None:
            prediction = self._model.predict(frame)
        else:
            # In portrait images gravity errs more often, and a wrong guess is confirmed by the next image.
            is_portrait = frame.camera.height > frame.camera.width
            known, is_asked = gravity.consensus.in_camera(gravity.R_world_camera, may_guess=not is_portrait)
            prediction = self._model.predict(replace(frame, gravity=known, gravity_is_guess=is_asked))
            if is_asked and prediction.gravity is not None:
                gravity.consensus.add(gravity.R_world_camera, prediction.gravity, prediction.gravity_share)
        if self._with_uncertainty or prediction.is_sensor:
            return prediction
        return replace(prediction, sigma_log=None)

    def take(self, frame: Frame) -> DepthPrediction:
        """The prediction for ``frame``; waits for it. The last one taken can be taken again."""
        with self._watch.timed("depth"):
            if self._last is None or self._last[0] is not frame:
                self.request(frame)
                n = next(n for n, (requested, _) in enumerate(self._requested) if requested is frame)
                self._last = (frame, self._requested[n][1].result())
                del self._requested[n]
            return self._last[1]

    def close(self) -> None:
        """End the thread; predictions that have not started are dropped."""
        self._pool.shutdown(wait=True, cancel_futures=True)


class Workers:
    """The tracker's threads.

    Attributes:
        depth: predicts depth.
        side: adjusts windows, estimates the readout time and describes places, all from copies.
        between: changes the map between two frames.
    """

    def __init__(self, depth: DepthWorker) -> None:
        self.depth = depth
        self.side = Worker("side")
        self.between = BetweenFrames()

    def close(self) -> None:
        """End all threads, whatever they are doing."""
        self.between.close()
        self.side.close()
        self.depth.close()


@contextmanager
def in_parallel(function: Callable[[_S], _T], items: Iterable[_S]) -> Iterator[list[Future[_T]]]:
    """Compute ``function`` of every item in as many threads as there are cores, while the body runs."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        yield [pool.submit(function, item) for item in items]


def _single_threaded(task: Callable[[], _T]) -> _T:
    with single_threaded():
        return task()
