"""Orbit messages: text to elements, states and ephemerides; `forms` is the registry."""
