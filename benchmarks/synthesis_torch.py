"""Torch's side of ``synthesis.py``: the same energy by ``torch.optim.LBFGS``, in torch's own way.

Needs torch and NumPy. Reads the problem from an ``.npz`` file and prints one JSON line.
"""

import json
import sys
import time

import numpy as np
import torch
from torch.nn import functional


def main(path: str, evaluations: int, search: str) -> None:
    """Minimise for a number of evaluations; values and clocks at each."""
    arrays = {name: torch.from_numpy(array) for name, array in np.load(path).items()}
    layers = sorted(name[7:] for name in arrays if name.startswith("kernel_"))
    kernels = {name: arrays[f"kernel_{name}"].permute(3, 2, 0, 1).contiguous() for name in layers}
    unknown = arrays["start"].clone().requires_grad_(True)
    calls: list[tuple[float, float, float]] = []

    def energy() -> torch.Tensor:
        image = 0.5 + 0.5 * torch.tanh(unknown)
        x = torch.stack([image, torch.ones_like(image)])[None]
        loss, block = torch.zeros(()), "1"
        for name in layers:
            if name[4] != block:
                x, block = functional.avg_pool2d(x, 2), name[4]
            x = functional.relu(
                functional.conv2d(x, kernels[name], arrays[f"bias_{name}"], padding=1)
            )
            if f"gram_{name}" in arrays:
                flat = x.reshape(x.shape[1], -1)
                gram = flat @ flat.T / flat.shape[1]
                loss = loss + ((gram - arrays[f"gram_{name}"]) ** 2).sum()
        return arrays["alpha"] * loss

    def closure() -> torch.Tensor:
        solver.zero_grad()
        loss = energy()
        loss.backward()
        calls.append((float(loss), time.perf_counter(), time.process_time()))
        return loss

    solver = torch.optim.LBFGS(
        [unknown],
        max_iter=10 * evaluations,
        max_eval=evaluations,
        history_size=10,
        tolerance_grad=0.0,
        tolerance_change=0.0,
        line_search_fn=None if search == "none" else search,
    )
    solver.step(closure)
    values, wall, processor = (list(column) for column in zip(*calls, strict=True))
    print(
        json.dumps(
            {"values": values, "wall": wall, "processor": processor}
            | {"version": torch.__version__, "threads": torch.get_num_threads()}
        )
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
