"""Text is taken when it is typed, not letter by letter."""

from unmix_plugin.viewer.page import WAIT_S, Debounced


def test_work_is_done_once_after_the_last_event():
    now, done = [0.0], []
    field = Debounced(lambda: done.append(now[0]), lambda: now[0])
    for _ in range(5):
        field.note()
        now[0] += WAIT_S / 2
        field.tick()
    assert done == []
    assert field.is_waiting
    now[0] += WAIT_S
    field.tick()
    field.tick()
    assert done == [now[0]]
    assert not field.is_waiting


def test_work_can_be_finished_at_once_and_only_if_there_is_some():
    done = []
    field = Debounced(lambda: done.append(1), lambda: 0.0)
    field.finish()
    assert done == []
    field.note()
    field.finish()
    field.tick()
    assert done == [1]
