"""A job reports in order, stops soon after it is told to, and never loses an error."""

import threading
import time

import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.job import Job


def run(work):
    job = Job(work)
    job.start()
    assert job.join(10)
    return list(job.events())


def test_events_arrive_in_order_and_end_with_the_result():
    def work(progress, send):
        progress(0.0, "start")
        send("stone")
        progress(1.0, "end")
        return "palette"

    assert run(work) == [("progress", 0.0, "start"), ("sent", "stone"), ("progress", 1.0, "end"), ("done", "palette")]


def test_work_runs_on_another_thread():
    assert run(lambda progress, send: threading.get_ident()) != [("done", threading.get_ident())]


@pytest.mark.parametrize("error", [PaletteError("bad mask"), MemoryError(), SystemExit(1)])
def test_an_error_arrives_as_it_was_raised(error):
    def work(progress, send):
        raise error

    assert run(work) == [("failed", error)]


def test_cancel_stops_within_half_a_second():
    started = threading.Event()

    def work(progress, send):
        for step in range(1000):
            progress(step / 1000, "working")
            started.set()
            time.sleep(0.05)

    job = Job(work)
    job.start()
    assert started.wait(5)
    asked = time.monotonic()
    job.cancel()
    assert job.join(0.5)
    assert time.monotonic() - asked < 0.5
    assert list(job.events())[-1] == ("cancelled",)


def test_time_left_is_the_rest_at_the_pace_so_far(monkeypatch):
    job = Job(lambda progress, send: None)
    assert job.seconds_left is None
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    job.start()
    job.join()
    job.fraction = 0.25
    assert job.seconds_left is None  # too early to tell
    now = 110.0
    assert job.seconds_left == pytest.approx(30.0)
    job.fraction = 1.0
    assert job.seconds_left == 0.0
