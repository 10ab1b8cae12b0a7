"""Times in PyTorch the matrix products that the example `products` lists, for comparison with a training step.

    target/release/examples/products --steps 1 | python harness/benches/products.py --steps 20

The list has one product of a convolution for each frame. Here these are one product over the whole batch, as in
PyTorch. Prints JSON, with times in wall-clock seconds.
"""

import argparse
import json
import statistics
import sys
import time

import torch

WARM_UP_STEPS = 2


def operands(product: dict) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns both factors, as they are stored in memory, and the result."""
    rows, inner, columns = product["rows"], product["inner"], product["columns"]
    frames = max(product["frames"], 1)
    # Each frame adds positions. A weight gradient sums over the positions, so they are its inner side.
    if product["name"].endswith("weight gradient"):
        inner *= frames
    else:
        columns *= frames
    left, right = [rows, inner], [inner, columns]
    left, right = (
        torch.randn(shape[::-1]).t() if transposed else torch.randn(shape)
        for shape, transposed in zip((left, right), product["transposed"])
    )
    return left, right, torch.empty(rows, columns)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    listed = json.load(sys.stdin)
    products = [operands(product) for product in listed["products"]]
    seconds = []
    for _ in range(WARM_UP_STEPS + options.steps):
        begin = time.perf_counter()
        for left, right, out in products:
            torch.mm(left, right, out=out)
        seconds.append(time.perf_counter() - begin)
    seconds = seconds[WARM_UP_STEPS:]
    report = {
        "median_seconds": statistics.median(seconds),
        "min_seconds": min(seconds),
        "max_seconds": max(seconds),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    print(json.dumps({"channels": listed["channels"], "latent": listed["latent"]} | report))


if __name__ == "__main__":
    main()
