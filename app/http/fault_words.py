"""What is wrong with a member or a parameter, in our own words: the validator's are for programmers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, get_args

from pydantic_core.core_schema import ErrorType

OWN: Final = frozenset(get_args(ErrorType))
"""The kinds of fault that the validator itself finds; others are found by checks of ours, which say it themselves."""
OBJECT: Final = "want an object of JSON"
TIME: Final = "want a time in ISO 8601 with its zone, such as 2026-11-22T10:00:00Z"
WORDS: Final[Mapping[str, str]] = {
    "missing": "it is needed and is not there",
    "extra_forbidden": "nothing of this name is known here",
    "string_type": "want a text",
    "string_unicode": "the text is not valid Unicode",
    "string_too_short": "want {min_length} characters at least",
    "string_too_long": "want {max_length} characters at most",
    "string_pattern_mismatch": "want a text of the form {pattern}",
    "int_type": "want a whole number",
    "int_parsing": "want a whole number",
    "int_parsing_size": "the number has too many digits",
    "int_from_float": "want a whole number",
    "float_type": "want a number",
    "float_parsing": "want a number",
    "finite_number": "want a finite number",
    "greater_than": "want a number above {gt}",
    "greater_than_equal": "want {ge} at least",
    "less_than": "want a number below {lt}",
    "less_than_equal": "want {le} at most",
    "bool_type": "want true or false",
    "bool_parsing": "want true or false",
    "literal_error": "want {expected}",
    "enum": "want {expected}",
    "none_required": "want null",
    "list_type": "want a list",
    "too_short": "want {min_length} of them at least",
    "too_long": "want {max_length} of them at most",
    "dict_type": OBJECT,
    "model_type": OBJECT,
    "model_attributes_type": OBJECT,
    "datetime_type": TIME,
    "json_invalid": "want JSON",
    "json_type": "want JSON",
    "union_tag_invalid": "{discriminator} is not one of {expected_tags}",
    "union_tag_not_found": "{discriminator} is needed and is not there",
    "value_error": "{error}",
}
OTHERWISE: Final = "it is not of the kind that the API documentation says"


def fault_in_words(kind: str, message: str, context: Mapping[str, object]) -> str:
    """Return what is wrong, without the value that was sent; ``message`` is taken of checks of ours alone."""
    if kind not in OWN:
        return message
    return WORDS.get(kind, OTHERWISE).format_map(context)
