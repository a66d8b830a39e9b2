"""The option `--sample` chooses a twentieth of the tests marked `sampled`, and no other tests."""

from types import SimpleNamespace

import pytest
from conftest import pytest_collection_modifyitems


@pytest.fixture
def choose():
    """Return a function that chooses from 4 ordinary tests and 45 sampled tests."""

    def chosen(commit: str | None) -> list[int]:
        items = [
            SimpleNamespace(number=i, get_closest_marker=lambda _, i=i: i >= 4 or None) for i in range(49)
        ]
        removed = []
        hook = SimpleNamespace(pytest_deselected=lambda items: removed.extend(items))
        pytest_collection_modifyitems(SimpleNamespace(getoption=lambda _: commit, hook=hook), items)
        assert len(items) + len(removed) == 49
        return [item.number for item in items]

    return chosen


def test_without_the_option_all_tests_run(choose):
    assert choose(None) == list(range(49))


def test_a_commit_always_chooses_the_same_twentieth_and_other_commits_choose_all_others(choose):
    choices = [choose(f"{commit:040x}") for commit in range(500)]
    assert choices[0] == choose(f"{0:040x}")
    for chosen in choices:
        assert chosen[:4] == [0, 1, 2, 3] and len(chosen) - 4 in (2, 3)
    assert sorted({number for chosen in choices for number in chosen}) == list(range(49))
    assert len({tuple(chosen) for chosen in choices}) == 20
