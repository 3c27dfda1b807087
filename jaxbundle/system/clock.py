"""The date of a computation, as results state it; it can be set, so that outputs are reproducible.

Source: reproducible-builds.org, the specification of SOURCE_DATE_EPOCH.
"""

import datetime
import os

from jaxbundle.errors import InputError

VARIABLE = "SOURCE_DATE_EPOCH"


def now() -> datetime.datetime:
    """The local time with its zone, or the time of the variable SOURCE_DATE_EPOCH (seconds since
    1970) in UTC.

    **Raises:** `InputError` for a variable that is no time."""
    seconds = os.environ.get(VARIABLE, "")
    if not seconds:
        return datetime.datetime.now().astimezone()
    try:
        return datetime.datetime.fromtimestamp(int(seconds), datetime.UTC)
    except (ValueError, OverflowError, OSError):
        raise InputError(
            f"{VARIABLE}: expected seconds since 1970, got {seconds[:30]!r}; correct or unset the "
            "environment variable"
        ) from None


def in_words(time: datetime.datetime) -> str:
    """Date, hours, minutes, and the zone if it is known."""
    return f"{time:%Y-%m-%d %H:%M %Z}".rstrip()
