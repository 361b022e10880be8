"""Tensors of a published file: views of one storage, each at its own offset and stride."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from mild_viz.published import read_pth


def test_tensors_of_one_storage_are_read_at_their_offsets(tmp_path: Path) -> None:
    base = torch.arange(12, dtype=torch.float32)
    views = {
        "model_h": base[:4],
        "model_r": base[5:9],
        "ssm": base[6:].view(2, 3).T,
        "args_h": base[3::4],
        "args_r": torch.tensor([7, 8, 9])[1:],
    }
    file = tmp_path / "views.pth"
    torch.save(views, file)
    content = read_pth(file)
    assert set(content) == set(views)
    for name, view in views.items():
        np.testing.assert_array_equal(content[name], view.numpy(), err_msg=name)
        assert content[name].dtype == view.numpy().dtype
