from __future__ import annotations

import numpy as np
import pytest

from droguekit.batch.task_queue import TaskQueue


def test_without_groups_the_order_stays() -> None:
    queue = TaskQueue([3, 1, 2])
    assert [queue.take(None, {0})[0] for _ in range(len(queue))] == [3, 1, 2]
    assert not queue


def test_a_process_ends_its_group_before_it_begins_another_and_leaves_those_of_others_alone() -> None:
    queue = TaskQueue(range(9), lambda index: index % 3)
    assert queue.take(None) == (0, 0)
    assert queue.take(None, {0}) == (1, 1)
    assert [queue.take(0, {1}) for _ in range(3)] == [(3, 0), (6, 0), (2, 2)]
    assert queue.take(1, {2}) == (4, 1)


def test_rows_are_groups_in_the_order_of_their_first_tasks() -> None:
    assert TaskQueue([5, 0, 4, 3, 2, 1], lambda index: index % 3).in_rows() == [5, 2, 0, 3, 4, 1]


def test_where_all_groups_are_held_the_one_with_the_most_tasks_is_shared() -> None:
    queue = TaskQueue([0, 1, 10, 11, 12], lambda index: index // 10)
    assert queue.take(None, {0, 1}) == (10, 1)
    # A tie goes to the earlier one.
    assert queue.take(None, {0, 1}) == (0, 0)


def test_a_task_that_failed_waits_behind_the_others_of_its_group() -> None:
    queue = TaskQueue([0, 1, 10], lambda index: index // 10)
    index, group = queue.take(None)
    queue.add(index)
    assert [queue.take(group)[0] for _ in range(3)] == [1, 0, 10]
    with pytest.raises(ValueError, match="none waits"):
        queue.take(None)
    queue.add(4)
    queue.clear()
    assert len(queue) == 0


@pytest.mark.parametrize("seed", range(8))
def test_groups_are_begun_once_and_once_more_for_each_process_that_joins_another(seed: int) -> None:
    rng = np.random.default_rng(seed)
    workers, groups, tasks = int(rng.integers(1, 6)), int(rng.integers(1, 30)), int(rng.integers(1, 200))
    group_of = rng.integers(groups, size=tasks).tolist()
    queue = TaskQueue(range(tasks), group_of.__getitem__)
    at: dict[int, int] = {}
    begun, done = 0, []
    while queue:
        worker = int(rng.integers(workers))
        others = {group for other, group in at.items() if other != worker}
        index, group = queue.take(at.get(worker), others)
        begun += at.get(worker) != group
        at[worker] = group
        done.append(index)
    assert sorted(done) == list(range(tasks))
    # At the end a worker without a group of its own may join each of the others' in turn.
    assert begun <= len(set(group_of)) + workers * (workers - 1)
