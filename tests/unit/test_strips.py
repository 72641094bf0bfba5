"""Strips of a pass that threads share: each is done once, and nobody waits for what never comes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import current_thread, main_thread

import numpy as np
import pytest

from scanner.decode import strips
from scanner.decode.gate import (
    ABANDONED,
    OPEN,
    SHUT,
    all_gone,
    come_and_go,
    new_gate,
    next_turn,
    set_gate,
    wait_for,
)
from scanner.decode.strips import MIN_STRIP, Shared, begins_of


@pytest.mark.parametrize("pixels", [1, MIN_STRIP, 320 * 240, 1392 * 1040 + 5, 1920 * 1200])
@pytest.mark.parametrize("threads", [1, 2, 4])
def test_strips_of_a_pass_make_up_the_image_and_grow_shorter(pixels, threads):
    begins = begins_of(pixels, threads)
    lengths = np.diff(begins)
    assert (begins[0], begins[-1]) == (0, pixels)
    assert (begins[:-1] % MIN_STRIP == 0).all()
    assert (np.diff(lengths) <= 0).all()
    assert lengths.size == 1 if threads == 1 else lengths.max() <= max(pixels / threads, 4 * MIN_STRIP)


def test_a_gate_lets_through_when_it_is_told_to():
    gate = new_gate()
    assert wait_for(gate) == SHUT
    for state in (OPEN, ABANDONED):
        set_gate(gate, state)
        assert wait_for(gate) == state


def test_who_is_at_work_is_waited_for_but_not_for_ever():
    gate = new_gate()
    assert all_gone(gate)
    come_and_go(gate, 1)
    assert not all_gone(gate)
    come_and_go(gate, -1)
    assert all_gone(gate)


def test_each_turn_is_taken_once():
    gate = new_gate()
    with ThreadPoolExecutor(4) as pool:
        taken = list(pool.map(lambda _: [next_turn(gate) for _ in range(500)], range(4)))
    assert sorted(n for of_one in taken for n in of_one) == list(range(2000))


def work_of(strips, taken, patience=True):
    """As `decode_strips`; without patience the first other thread leaves a shut gate at once."""

    def work(gate, counts):
        if not patience and not taken and current_thread() is not main_thread():
            taken.append(-1)
            return False
        state = wait_for(gate)
        if state != OPEN:
            return state != SHUT
        come_and_go(gate, 1)
        while (strip := next_turn(gate)) < strips:
            taken.append(strip)
            counts[:] += (1, strip)
        come_and_go(gate, -1)
        return True

    return work


@pytest.mark.parametrize("threads", [1, 2, 4])
@pytest.mark.parametrize("patience", [True, False])
def test_every_strip_is_done_once_by_threads_that_waited_or_left(threads, patience):
    taken = []
    with Shared(work_of(40, taken, patience), threads, 2) as shared:
        shared.open()
        counts = shared.finish()
    assert sorted(n for n in taken if n >= 0) == list(range(40))
    assert counts.tolist() == [40, sum(range(40))]


@pytest.mark.parametrize("opened", [False, True])
def test_what_fails_is_told_when_the_others_are_done_or_sent_away(opened):
    taken = []

    def failing():
        with Shared(work_of(40, taken), 3, 2) as shared:
            if opened:
                shared.open()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()
    assert len(taken) in ((0, 40) if opened else (0,))


def test_an_interrupt_before_the_context_leaves_no_thread_waiting():
    Shared(work_of(40, []), 4, 2)  # as if a signal came between the call and the `with`
    assert [future.result() for future in (strips._crew().submit(int) for _ in range(3))] == [0, 0, 0]


@pytest.mark.parametrize("refused", [0, 1])
def test_without_more_threads_one_does_it_all(refused, monkeypatch):
    crew, submitted = strips._crew(), []

    class Short:
        def submit(self, *call):
            submitted.append(crew.submit(*call))  # handed over, and nobody is told
            if len(submitted) > refused:
                raise RuntimeError("can't start new thread")
            return submitted[-1]

    taken = []
    monkeypatch.setattr(strips, "_crew", Short)
    with Shared(work_of(40, taken), 3, 2) as shared:
        shared.open()
        counts = shared.finish()
    assert taken == list(range(40))
    assert counts.tolist() == [40, sum(range(40))]
    assert all(future.result() for future in submitted)
