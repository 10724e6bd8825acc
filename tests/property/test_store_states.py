"""A database goes through what people and failures do to it, and is always what a plain model says."""

import pytest

from tests.support.store_machine import StoreMachine, run


def test_some_steps() -> None:
    run(StoreMachine, 4, 12)
    assert StoreMachine.kills > 0


@pytest.mark.evaluation
@pytest.mark.timeout(7200)
def test_two_thousand_steps() -> None:
    run(StoreMachine, 95, 26)
    assert StoreMachine.steps >= 2000
    assert StoreMachine.kills > 200
