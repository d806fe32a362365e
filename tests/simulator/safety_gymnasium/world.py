"""The module that reads the assets."""

import yaml  # noqa: F401
