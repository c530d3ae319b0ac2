# SPDX-License-Identifier: Apache-2.0
"""Keyframes, their features, and landmarks as plain arrays, and back.

Both maps on disk (:mod:`slamdepth.mapstore`) and checkpoints of a run are made of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamdepth.errors import DatasetError
from slamdepth.frontend.features import Features
from slamdepth.frontend.metric import ORB, DescriptorMetric, Hamming, UnitL2
from slamdepth.io.tree import Tree
from slamdepth.mapping.keyframe_store import StoredFrame, StoredPrediction
from slamdepth.mapping.landmarks import Landmarks
from slamdepth.mapping.map_keyframe import KeyframeState, MapKeyframe
from slamdepth.types import DepthKind
from slamdepth.typing import Floats

Arrays = Mapping[str, NDArray[Any]]

_METRICS: dict[str, type[Hamming] | type[UnitL2]] = {"hamming": Hamming, "unit_l2": UnitL2}


def metric_state(metric: DescriptorMetric) -> Tree:
    """A metric as plain values."""
    name = next(name for name, kind in _METRICS.items() if isinstance(metric, kind))
    return {"name": name, **asdict(metric)}  # type: ignore[call-overload]


def metric_of(state: Mapping[str, Any]) -> DescriptorMetric:
    """What :func:`metric_state` was given.

    Raises:
        DatasetError: there is no such metric.
    """
    values = dict(state)
    try:
        return _METRICS[values.pop("name")](**values)
    except (KeyError, TypeError) as error:
        raise DatasetError(f"descriptors are compared in a way that is not known here: {error}") from error


def features_state(features: Features) -> Tree:
    """The arrays of one image's features."""
    return {name: getattr(features, name) for name in ("raw_px", "px", "octave", "sigma_px", "descriptors")}


def features_of(state: Arrays, metric: DescriptorMetric) -> Features:
    """What :func:`features_state` was given. Words and matchers of networks are not among it."""
    return Features(
        raw_px=np.array(state["raw_px"]),
        px=np.array(state["px"]),
        octave=np.asarray(state["octave"], dtype=np.int64),
        sigma_px=np.array(state["sigma_px"]),
        descriptors=np.array(state["descriptors"]),
        metric=metric,
        orb_descriptors=None if metric == ORB else _not_kept,
    )


def _not_kept() -> NDArray[np.uint8]:
    raise DatasetError("the words of a saved keyframe are in its place vector, not in its features")


def keyframe_arrays(keyframes: Sequence[MapKeyframe]) -> dict[str, NDArray[Any]]:
    """Keyframes of a map; see ``keyframes`` in :data:`slamdepth.mapstore.format.ARRAYS`."""
    features: list[Features] = [keyframe.features for keyframe in keyframes]
    counts = [len(one) for one in features]
    predictions = [keyframe.prediction for keyframe in keyframes]
    none = np.full(3, np.nan)

    def each(values: Sequence[Any], dtype: Any, *shape: int) -> NDArray[Any]:
        return np.array(values, dtype=dtype).reshape(len(keyframes), *shape)

    def joined(arrays: Sequence[NDArray[Any]], dtype: Any) -> NDArray[Any]:
        return np.concatenate([np.asarray(array, dtype=dtype) for array in arrays])

    return {
        "first_feature": np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        "T_camera_world": each([k.T_camera_world for k in keyframes], np.float64, 4, 4),
        "timestamp_s": each([k.frame.timestamp_s for k in keyframes], np.float64),
        "frame": each([k.frame.index for k in keyframes], np.int64),
        "session": each([k.session for k in keyframes], np.int64),
        "velocity": each([k.velocity for k in keyframes], np.float64, 6),
        "scale": each([k.scale for k in keyframes], np.float64),
        "unit": each([k.unit for k in keyframes], np.float64),
        "gravity": each([_or(k.frame.gravity, none) for k in keyframes], np.float64, 3),
        "has_prediction": each([p is not None for p in predictions], np.bool_),
        "is_sensor": each([p is not None and p.is_sensor for p in predictions], np.bool_),
        "has_predicted_log_depth": each([len(k.predicted_log_depth) > 0 for k in keyframes], np.bool_),
        "predicted_gravity": each(
            [_or(None if p is None else p.gravity, none) for p in predictions], np.float64, 3
        ),
        "predicted_gravity_share": each(
            [0.0 if p is None else p.gravity_share for p in predictions], np.float64
        ),
        "scale_sigma_log": each(
            [np.nan if p is None or p.scale_sigma_log is None else p.scale_sigma_log for p in predictions],
            np.float64,
        ),
        "raw_px": joined([one.raw_px for one in features], np.float64),
        "px": joined([one.px for one in features], np.float64),
        "octave": joined([one.octave for one in features], np.uint8),
        "sigma_px": joined([one.sigma_px for one in features], np.float64),
        "descriptor": np.concatenate([one.descriptors for one in features]),
        "landmark": joined([k.landmark_ids for k in keyframes], np.int32),
        "log_depth": joined([k.log_depth for k in keyframes], np.float64),
        "sigma_log": joined([k.sigma_log for k in keyframes], np.float64),
        "predicted_log_depth": joined(
            [
                k.predicted_log_depth if len(k.predicted_log_depth) else np.full(count, np.nan)
                for k, count in zip(keyframes, counts, strict=True)
            ],
            np.float64,
        ),
    }


def _or(value: Floats | None, default: Floats) -> Floats:
    return default if value is None else value


def keyframe_states(
    arrays: Arrays,
    metric: DescriptorMetric,
    frame_of: Callable[[int, int, float, Floats | None], StoredFrame],
    read_prediction: Callable[[int, StoredFrame], Callable[[], Any] | None],
) -> list[KeyframeState]:
    """What :func:`keyframe_arrays` was given.

    Args:
        frame_of: makes the handle of a frame: number of the keyframe, frame, time, gravity.
        read_prediction: what reads the prediction of a keyframe; None where it was not kept.
    """
    first = arrays["first_feature"].tolist()
    states = []
    for n in range(len(arrays["timestamp_s"])):
        at = slice(first[n], first[n + 1])
        features = features_of(
            {
                **{name: arrays[name][at] for name in ("raw_px", "px", "octave", "sigma_px")},
                "descriptors": arrays["descriptor"][at],
            },
            metric,
        )
        stored = frame_of(
            n,
            int(arrays["frame"][n]),
            float(arrays["timestamp_s"][n]),
            _known(arrays["gravity"][n]),
        )
        sigma = float(arrays["scale_sigma_log"][n])
        prediction = None
        if arrays["has_prediction"][n]:
            prediction = StoredPrediction.of_saved(
                DepthKind.METRIC,
                is_sensor=bool(arrays["is_sensor"][n]),
                gravity=_known(arrays["predicted_gravity"][n]),
                gravity_share=float(arrays["predicted_gravity_share"][n]),
                scale_sigma_log=None if np.isnan(sigma) else sigma,
                read=read_prediction(n, stored),
            )
        predicted = np.array(arrays["predicted_log_depth"][at])
        states.append(
            KeyframeState(
                id=n,
                frame=stored,
                features=features,
                T_camera_world=np.array(arrays["T_camera_world"][n]),
                landmark_ids=arrays["landmark"][at].astype(np.int64),
                log_depth=np.array(arrays["log_depth"][at]),
                sigma_log=np.array(arrays["sigma_log"][at]),
                velocity=np.array(arrays["velocity"][n]),
                prediction=prediction,
                predicted_log_depth=predicted if arrays["has_predicted_log_depth"][n] else np.zeros(0),
                scale=float(arrays["scale"][n]),
                unit=float(arrays["unit"][n]),
                session=int(arrays["session"][n]),
            )
        )
    return states


def _known(value: Floats) -> Floats | None:
    return None if np.isnan(value).any() else np.array(value)


def landmark_arrays(landmarks: Landmarks) -> dict[str, NDArray[Any]]:
    """All landmarks, living or not."""
    return {field.name: np.array(getattr(landmarks, field.name)) for field in fields(landmarks)}


def landmarks_of(arrays: Arrays) -> Landmarks:
    """What :func:`landmark_arrays` was given."""
    return Landmarks(**{field.name: arrays[field.name] for field in fields(Landmarks)})
