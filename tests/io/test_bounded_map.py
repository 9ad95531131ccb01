"""Work in threads: in order, several at a time, and never more together than the bound."""

import threading
import time

import pytest

from mi_refract.io.image_file import AHEAD, bounded_map


class Work:
    """Counts what is held: from the start of the work until the answer is taken."""

    def __init__(self):
        self.lock, self.held, self.most = threading.Lock(), 0, 0

    def __call__(self, item):
        with self.lock:
            self.held += item
            self.most = max(self.most, self.held)
        time.sleep(0.002)
        return item

    def answers(self, items, most, threads=4):
        for answer in bounded_map(self, items, lambda item: item, most, threads):
            yield answer
            with self.lock:
                self.held -= answer


@pytest.mark.parametrize("most", [5, 12, 100])
def test_the_bound_holds_and_the_order_too(most):
    work, items = Work(), [1, 5, 2, 2, 0, 7, 3, 1, 1, 1, 4, 0, 0, 6] * 3
    assert list(work.answers(items, most)) == items
    assert work.most <= max(most, 7)
    assert work.most > 7 or most == 5


def test_what_takes_more_than_all_is_alone():
    work = Work()
    assert list(work.answers([1, 1, 9, 1, 9, 9], 3)) == [1, 1, 9, 1, 9, 9]
    assert work.most == 9


@pytest.mark.parametrize("takes", [0, 1])
def test_threads_work_at_the_same_time_to_the_end(takes):
    gate = threading.Barrier(4, timeout=10)
    assert list(bounded_map(lambda item: gate.wait() >= 0, range(20), lambda item: takes, 4, 4)) == [True] * 20


def test_an_error_is_raised_in_its_turn():
    found = []
    with pytest.raises(ZeroDivisionError):
        for answer in bounded_map(lambda item: 6 // item, [1, 2, 0, 3], lambda item: item, 9, 2):
            found.append(answer)
    assert found == [6, 3]


def test_what_has_not_begun_when_it_is_interrupted_is_left():
    begun = []

    def work(item):
        begun.append(item)
        time.sleep(0.3)

    def takes(item):
        if item == AHEAD:
            raise KeyboardInterrupt
        return 0

    with pytest.raises(KeyboardInterrupt):
        list(bounded_map(work, range(10), takes, 1, 1))
    assert begun in ([], [0])
