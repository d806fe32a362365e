"""Test-wide settings."""

from __future__ import annotations

import torch

# As in training: at these sizes a second thread only waits for the first.
torch.set_num_threads(1)
