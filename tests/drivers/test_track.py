"""Where the stage was between two reports: the error is what the module's docstring says."""

from __future__ import annotations

import math

import pytest

from drivers.clock import NS
from drivers.track import AHEAD_S, Arc, Track

ARC = Arc((10.0, -5.0), 1.5)


def circle_track(speed: float, hz: float, seconds: float = 2.0) -> Track:
    track = Track()
    for k in range(int(seconds * hz) + 1):
        t = k / hz
        point = ARC.point(speed * t / ARC.radius)
        track.add(round(t * NS) + 1, point, speed=speed, arc=ARC, at_rest=False)
    return track


@pytest.mark.parametrize("turns_per_report", [0.1, 0.45, 0.8, 1.7, 3.3])
def test_steady_circle_is_followed_exactly_over_whole_turns_too(turns_per_report: float) -> None:
    hz = 10.0
    speed = turns_per_report * hz * math.tau * ARC.radius
    track = circle_track(speed, hz)
    for k in range(1, 190):
        t = k / 100
        found = track.at(round(t * NS) + 1)
        assert found is not None
        assert math.dist(found, ARC.point(speed * t / ARC.radius)) < 1e-5


@pytest.mark.parametrize("on_arc", [True, False])
def test_acceleration_costs_no_more_than_an_eighth_a_dt_squared(on_arc: bool) -> None:
    a, hz = 100.0, 10.0
    track = Track()
    truth = []
    for k in range(101):
        t = k / 100
        way = a * t * t / 2
        point = ARC.point(way / ARC.radius) if on_arc else (way, 2.0)
        truth.append(point)
        if k % round(100 / hz) == 0:
            track.add(
                round(t * NS) + 1, point, speed=a * t, arc=ARC if on_arc else None, at_rest=False
            )
    worst = 0.0
    for k, point in enumerate(truth[:-1]):
        found = track.at(round(k / 100 * NS) + 1)
        assert found is not None
        worst = max(worst, math.dist(found, point))
    assert 0.5 * a / hz**2 / 8 < worst <= a / hz**2 / 8 + 1e-6


def test_clockwise_motion_has_a_negative_speed() -> None:
    track = Track()
    track.add(1, ARC.point(0.0), speed=-30.0, arc=ARC, at_rest=False)
    track.add(1 + NS // 4, ARC.point(-5.0), speed=-30.0, arc=ARC, at_rest=False)
    middle = track.at(1 + NS // 8)
    assert middle is not None
    assert math.dist(middle, ARC.point(-2.5)) < 1e-6


def test_unknown_before_the_first_report_and_long_after_the_last() -> None:
    track = circle_track(25.0, 10.0, seconds=1.0)
    assert track.at(0) is None
    end = NS + 1
    ahead = track.at(end + round(0.9 * AHEAD_S * NS))
    assert ahead is not None
    assert math.dist(ahead, ARC.point(25.0 * (1 + 0.9 * AHEAD_S) / 1.5)) < 1e-5
    assert track.at(end + round(1.1 * AHEAD_S * NS)) is None


def test_a_long_gap_in_motion_is_not_guessed() -> None:
    track = Track()
    track.add(1, (0.0, 0.0), speed=5.0, arc=None, at_rest=False)
    track.add(1 + 2 * NS, (10.0, 0.0), speed=5.0, arc=None, at_rest=False)
    assert track.at(NS) is None


def test_at_rest_it_stays_until_it_departs() -> None:
    track = Track()
    track.add(1, (3.0, 4.0), speed=0.0, arc=None, at_rest=True)
    assert track.at(3600 * NS) == (3.0, 4.0)
    track.depart(10 * NS)
    track.add(10 * NS + NS // 10, (4.0, 4.0), speed=10.0, arc=None, at_rest=False)
    assert track.at(10 * NS) == (3.0, 4.0)
    between = track.at(10 * NS + NS // 20)
    assert between == pytest.approx((3.5, 4.0))


def test_forget_leaves_nothing() -> None:
    track = circle_track(25.0, 10.0)
    track.forget()
    assert track.at(NS) is None


def test_memory_is_constant() -> None:
    track = Track(length=100)
    for k in range(10_000):
        track.add(k, (k, 0.0), speed=1.0, arc=None, at_rest=False)
    assert len(track._samples) == 100
