"""Numbers of frames: each frame is taken in once, and a kept state is good up to a number."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from pipelines.serving.frame_order import Numbering


def test_what_is_held_is_known_and_not_settled():
    numbers = Numbering()
    numbers.take("a", 0)
    numbers.hold("a", 1)
    numbers.hold("a", 3)
    numbers.take("a", 2)  # was younger, and went in before
    assert [numbers.known("a", n) for n in range(5)] == ["taken"] * 4 + [None]
    assert numbers.durable() == {"a": 0}


def test_held_frames_of_a_kept_state_may_come_again_once():
    before, after = Numbering(), Numbering()
    before.take("a", 0)
    before.hold("a", 1)
    before.take("a", 2)
    after.restore(before.state())
    assert [after.known("a", n) for n in range(4)] == ["taken", None, "taken", None]
    after.take("a", 1)
    assert (after.known("a", 1), after.durable(), after.taken["a"]) == ("taken", {"a": 2}, 3)


def test_a_client_that_goes_on_gives_up_what_it_has_not_sent_again():
    before, after = Numbering(), Numbering()
    before.hold("a", 1)
    before.take("a", 2)
    after.restore(before.state())
    assert after.durable() == {"a": 0}
    after.take("a", 3)
    assert (after.known("a", 1), after.durable()) == ("taken", {"a": 3})


@given(st.lists(st.tuples(st.integers(0, 12), st.booleans()), max_size=30), st.integers(0, 30))
def test_going_on_after_the_durable_number_takes_every_frame_in_once(frames: list[tuple[int, bool]], crash: int):
    """Frames 0, 1, 2... of which some are held for a while; the service is killed, and the rest is sent again."""
    taken: list[int] = []
    numbers, held = Numbering(), list[int]()

    def send(k: int, hold: bool) -> None:
        if numbers.known("a", k) is None:
            if hold:
                numbers.hold("a", k)
                held.append(k)
            else:
                numbers.take("a", k)
                taken.append(k)

    def settle() -> None:
        while held:
            numbers.release("a", held[0])
            numbers.take("a", held[0])
            taken.append(held.pop(0))

    for k, (turn, hold) in enumerate(frames[:crash]):
        send(k, hold)
        if turn == 0:
            settle()
    durable, state = numbers.durable().get("a", -1), numbers.state()
    numbers, held = Numbering(), []
    numbers.restore(state)
    for k in range(durable + 1, len(frames)):
        send(k, frames[k][1])
    settle()
    assert sorted(taken) == list(range(len(frames)))
    assert numbers.taken["a"] == len(frames)
