# SPDX-License-Identifier: Apache-2.0
"""Units of time: recognised by header, size and spacing, and converted exactly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamdepth.io.times import TimeColumn, TimeUnit, conversion_notes, judge_unit, settle_unit

START_NS = 1403636579763555584
S, MS, US, NS = TimeUnit
Count = Callable[[int], object]


def column(at: Count, count: int = 40, stated: TimeUnit | None = None) -> TimeColumn:
    return TimeColumn(tuple(str(at(i)) for i in range(count)), stated)


SECONDS: dict[str, Count] = {
    "from zero": lambda i: f"{i / 30:.6f}",
    "since 1970": lambda i: f"{1305031229.528748 + i / 30:.6f}",
    "one a second, whole": lambda i: i,
    "one a second, whole, since 1970": lambda i: 1700000000 + i,
    "one in two seconds": lambda i: f"{2 * i}",
    "time-lapse since 1970": lambda i: 1700000000 + 30 * i,
    "a thousand a second": lambda i: f"{i / 1000:.3f}",
    "motion capture at 2 kHz": lambda i: f"{i / 2000:.4f}",
}


@pytest.mark.parametrize("of_images", [True, False])
@pytest.mark.parametrize("kind", SECONDS)
def test_seconds_stay_as_they_are_without_a_word(kind: str, of_images: bool) -> None:
    times = column(SECONDS[kind])
    verdict = judge_unit(times, of_images=of_images)
    assert verdict.unit is S
    assert conversion_notes("rgb.txt", times, verdict) == []
    np.testing.assert_array_equal(times.seconds(S), [float(text) for text in times.texts])


CONVERTED: dict[str, tuple[Count, TimeUnit]] = {
    "ns since 1970": (lambda i: START_NS + i * 33333333, NS),
    "ns since 1970 as floats": (lambda i: f"{float(START_NS + i * 33333333):.18e}", NS),
    "us since 1970": (lambda i: START_NS // 1000 + i * 33333, US),
    "ms since 1970": (lambda i: START_NS // 10**6 + round(i * 33.3), MS),
    "ns from zero": (lambda i: i * 33333333, NS),
    "us from zero": (lambda i: i * 33333, US),
    "ms from zero": (lambda i: round(i * 1000 / 30), MS),
    "ms at 60 Hz": (lambda i: round(i * 1000 / 60), MS),
    "ms of a video, with decimals": (lambda i: i * 1000 / 30, MS),
    "ns since the device was switched on": (lambda i: 18_000 * 10**9 + i * 33333333, NS),
    "us since the device was switched on": (lambda i: 3_600 * 10**6 + i * 33333, US),
}


@pytest.mark.parametrize("of_images", [True, False])
@pytest.mark.parametrize("kind", CONVERTED)
def test_other_units_are_recognised_and_noted(kind: str, of_images: bool) -> None:
    at, unit = CONVERTED[kind]
    times = column(at)
    verdict = judge_unit(times, of_images=of_images)
    assert verdict.unit is unit
    (note,) = conversion_notes("rgb.txt", times, verdict)
    assert f"times are in {unit.words}" in note
    assert f"divided by 1e{unit.places} to seconds" in note


@pytest.mark.parametrize("at", [lambda i: 40 * i, lambda i: 200 * i], ids=["25 Hz", "5 Hz"])
def test_even_milliseconds_of_images_are_recognised(at: Count) -> None:
    assert judge_unit(column(at), of_images=True).unit is MS


def test_a_rate_of_the_camera_file_speaks_for_milliseconds() -> None:
    times = column(lambda i: f"{i * 1000 / 14:.3f}")
    assert judge_unit(times, of_images=True).unit is S
    assert judge_unit(times, of_images=True, fps=14.0).unit is MS


@pytest.mark.parametrize(
    "at", [lambda i: f"{30 * i:.6f}", lambda i: 30 * i, lambda i: f"{20 * i:.6f}"], ids=["30.0", "30", "20.0"]
)
def test_a_time_lapse_from_zero_stays_in_seconds_with_a_note(at: Count) -> None:
    verdict = judge_unit(column(at), of_images=True)
    assert verdict.unit is S
    assert "taken for seconds; if they are milliseconds" in verdict.note


@pytest.mark.parametrize("step", [1, 5, 10])
def test_numbers_of_frames_and_of_keyframes_are_no_milliseconds(step: int) -> None:
    assert judge_unit(column(lambda i: step * i), of_images=False).unit is S
    numbers = np.cumsum(np.random.default_rng(0).integers(3, 12, 40))
    assert judge_unit(column(lambda i: numbers[i]), of_images=False).unit is S


def test_times_in_no_unit_have_none() -> None:
    ticks = column(lambda i: 130_000_000_000_000_000 + i * 333_333)  # of 100 ns since 1601
    assert judge_unit(ticks, of_images=True).unit is None


def test_a_header_is_believed_unless_the_times_contradict_it() -> None:
    assert judge_unit(column(lambda i: 30 * i, stated=MS), of_images=True).unit is MS
    seconds = column(lambda i: f"{1403636579.7 + i / 30:.6f}", stated=NS)
    verdict = judge_unit(seconds, of_images=True)
    assert (verdict.unit, verdict.is_sure) == (S, True)
    assert "the header says nanoseconds, but the times are seconds since 1970" in verdict.note


def test_another_list_of_the_recording_decides_what_is_not_clear() -> None:
    times = column(lambda i: 10 * i, 130)
    verdict = judge_unit(times, of_images=False)
    assert (verdict.unit, verdict.is_sure) == (S, False)
    assert settle_unit(times, verdict, np.linspace(0.0, 1.3, 40)).unit is MS
    assert settle_unit(times, verdict, np.linspace(0.0, 1170.0, 40)).unit is S
    assert settle_unit(times, verdict, None).unit is S
    another_day = column(lambda i: 99999 + i)
    verdict = judge_unit(another_day, of_images=False)
    assert settle_unit(another_day, verdict, np.linspace(0.0, 1.3, 40)).unit is S
    single = column(lambda i: 99999, 1)
    assert settle_unit(single, judge_unit(single, of_images=False), np.linspace(0.0, 1.3, 40)).unit is S


@given(st.integers(6 * 10**17, 4 * 10**18), st.integers(10**6, 10**9), st.integers(3, 30))
def test_nanoseconds_become_the_nearest_seconds(start: int, step: int, count: int) -> None:
    """The same float64 as of the decimal seconds: no rounding on the way, and times still increase."""
    times = column(lambda i: start + i * step, count)
    expected = [float(f"{t // 10**9}.{t % 10**9:09d}") for t in range(start, start + count * step, step)]
    assert judge_unit(times, of_images=False).unit is NS
    found = times.seconds(NS)
    assert found.tolist() == expected
    assert (np.diff(found) > 0).all()


@given(
    fps=st.floats(0.55, 490.0),
    start=st.sampled_from([0.0, 1305031229.5]),
    unit=st.sampled_from([US, NS]),
    shake=st.floats(0.0, 0.1),
)
def test_any_camera_in_microseconds_or_nanoseconds_from_any_origin(
    fps: float, start: float, unit: TimeUnit, shake: float
) -> None:
    rng = np.random.default_rng(1)
    seconds = start + (np.arange(30) + shake * rng.random(30)) / fps
    times = TimeColumn(tuple(f"{int(second * 10**unit.places)}" for second in seconds))
    verdict = judge_unit(times, of_images=True)
    assert verdict.unit is unit
    np.testing.assert_allclose(times.seconds(unit), seconds, rtol=0, atol=3e-6)


@given(st.lists(st.floats(-1e300, 1e300), min_size=1, max_size=30), st.booleans())
def test_any_times_are_judged(values: list[float], of_images: bool) -> None:
    times = TimeColumn(tuple(repr(value) for value in sorted(values)))
    verdict = judge_unit(times, of_images=of_images)
    conversion_notes("a.txt", times, verdict)
    if verdict.unit is not None:
        assert len(times.seconds(verdict.unit)) == len(values)
