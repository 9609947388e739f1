"""Torch's side of ``features.py``: the same loss and gradient, in torch's own environment.

Needs torch alone. Prints one JSON line.
"""

import ctypes
import json
import resource
import sys
import time

import torch
from torch.nn import functional

BLOCKS = ((2, 64), (2, 128), (4, 256), (4, 512), (1, 512))


def main(side: int, calls: int) -> None:
    """Time the gradient of the Gram loss on five layers with respect to a one-channel image."""
    if sys.platform == "linux":
        # Freed memory stays with the process (M_MMAP_MAX, M_TRIM_THRESHOLD), as with ours.
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(-4, 0)
        mallopt(-1, 2**31 - 1)
    torch.manual_seed(0)
    kernels, channels = [], 1
    for count, width in BLOCKS:
        block = []
        for _ in range(count):
            block.append(torch.randn(width, channels, 3, 3) * (2 / (9 * channels)) ** 0.5)
            channels = width
        kernels.append(block)
    image = torch.rand(1, 1, side, side, requires_grad=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, processor = [], []
    for _ in range(calls):
        image.grad = None
        start = time.perf_counter(), time.process_time()
        x, loss = image, torch.zeros(())
        for index, block in enumerate(kernels):
            x = functional.avg_pool2d(x, 2) if index else x
            for place, kernel in enumerate(block):
                x = functional.relu(
                    functional.conv2d(x, kernel, torch.zeros(kernel.shape[0]), padding=1)
                )
                if place == 0:
                    flat = x.reshape(x.shape[1], -1)
                    loss = loss + ((flat @ flat.T / flat.shape[1] - 1) ** 2).sum()
        loss.backward()
        wall.append(time.perf_counter() - start[0])
        processor.append(time.process_time() - start[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        json.dumps(
            {"wall": wall, "processor": processor, "memory": (peak - before) / 1024, "compile": 0}
            | {"version": torch.__version__, "threads": torch.get_num_threads()}
        )
    )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
