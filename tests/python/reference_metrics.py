"""Metrics and ridge regression as scikit-learn and NumPy compute them, for the Rust tests to compare with.

Reads JSON from standard input and writes JSON to standard output. Either part may be absent:

    {"reference": [...], "predicted": [...]}
        -> {"smape", "wmape", "r2", "rmse", "mae"}; smape and wmape in percent, as the paper defines them;
           smape counts zero against zero as no error; wmape is null where every reference value is zero;
           the columns of a [samples, columns] matrix are pooled
    {"ridge": {"x": [[...]], "y": [[...]], "alpha": a}}
        -> {"ridge": {"coefficients": [outputs][inputs], "intercept": [outputs]}}
"""

import json
import sys

import numpy as np
from sklearn.linear_model import Ridge
from sklearn.metrics import mean_absolute_error, r2_score, root_mean_squared_error


def smape(reference: np.ndarray, predicted: np.ndarray) -> float:
    magnitude = np.abs(reference) + np.abs(predicted)
    error = np.abs(reference - predicted)
    ratio = np.divide(error, magnitude, out=np.zeros_like(error), where=magnitude > 0)
    return 100 * ratio.mean()


def wmape(reference: np.ndarray, predicted: np.ndarray) -> float | None:
    magnitude = np.abs(reference).sum()
    return 100 * np.abs(reference - predicted).sum() / magnitude if magnitude > 0 else None


def metrics(reference: np.ndarray, predicted: np.ndarray) -> dict[str, float | None]:
    return {
        "smape": smape(reference, predicted),
        "wmape": wmape(reference, predicted),
        "r2": r2_score(reference, predicted, multioutput="variance_weighted"),
        "rmse": root_mean_squared_error(reference.ravel(), predicted.ravel()),
        "mae": mean_absolute_error(reference, predicted),
    }


def ridge(x: list[list[float]], y: list[list[float]], alpha: float) -> dict[str, list]:
    model = Ridge(alpha=alpha).fit(np.array(x), np.array(y))
    return {"coefficients": model.coef_.tolist(), "intercept": model.intercept_.tolist()}


def main() -> None:
    request = json.load(sys.stdin)
    answer = {}
    if "reference" in request:
        answer |= metrics(np.array(request["reference"], float), np.array(request["predicted"], float))
    if "ridge" in request:
        answer["ridge"] = ridge(**request["ridge"])
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
