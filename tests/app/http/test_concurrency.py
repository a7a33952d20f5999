"""Places for calculations inside a request."""

import pytest

from app.errors import BusyError
from app.http.concurrency import Places


def test_who_finds_no_place_in_time_is_told_and_a_place_that_is_left_is_free_again():
    places = Places("studies", at_once=1, wait_s=0.0)
    with places.one(), pytest.raises(BusyError, match="as many studies run"), places.one():
        pytest.fail("a second one has a place")
    with pytest.raises(ZeroDivisionError), places.one():
        raise ZeroDivisionError
    with places.one():
        pass
