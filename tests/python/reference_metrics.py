"""Metrics and ridge regression as scikit-learn, scoringrules and NumPy compute them, for the Rust tests to compare with.

Reads JSON from standard input and writes JSON to standard output. Either part may be absent:

    {"reference": [...], "predicted": [...]}
        -> {"smape", "wmape", "r2", "rmse", "mae"}; smape and wmape in percent, as the paper defines them;
           smape counts zero against zero as no error; wmape is null where every reference value is zero;
           the columns of a [samples, columns] matrix are pooled
    {"ridge": {"x": [[...]], "y": [[...]], "alpha": a}}
        -> {"ridge": {"coefficients": [outputs][inputs], "intercept": [outputs]}}
    {"distributions": {"reference": [...], "members": [[...]], "draws": true or false}}
        -> {"distributions": {"crps": [...], "intervals": {"50": [lows, highs], "90": [lows, highs]}}}
    {"contacts": {"touches": [...], "predicted": [...], "scores": [...]}}
        -> {"contacts": {"f1", "auc"}}
    {"categories": {"category": [...], "probabilities": [[...]]}}
        -> {"categories": {"accuracy", "balanced_accuracy", "log_loss", "confusion"}}; float32, as the program has them
"""

import json
import sys

import numpy as np
import scoringrules
from sklearn.linear_model import Ridge
from sklearn.metrics import accuracy_score, balanced_accuracy_score, confusion_matrix, log_loss
from sklearn.metrics import f1_score, mean_absolute_error, r2_score, roc_auc_score, root_mean_squared_error


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


def distributions(reference: list[float], members: list[list[float]], draws: bool) -> dict:
    values, estimator, method = np.array(members), "fair" if draws else "nrg", "weibull" if draws else "hazen"
    bounds = {percent: [50 - percent / 2, 50 + percent / 2] for percent in (50, 90)}
    return {
        "crps": scoringrules.crps_ensemble(np.array(reference), values, estimator=estimator).tolist(),
        "intervals": {p: np.percentile(values, at, axis=1, method=method).tolist() for p, at in bounds.items()},
    }


def contacts(touches: list[bool], predicted: list[bool], scores: list[float]) -> dict[str, float]:
    return {"f1": f1_score(touches, predicted), "auc": roc_auc_score(touches, scores)}


def categories(category: list[int], probabilities: list[list[float]]) -> dict[str, object]:
    values = np.array(probabilities, np.float32)
    labels, predicted = range(values.shape[1]), values.argmax(axis=1)
    return {
        "accuracy": accuracy_score(category, predicted),
        "balanced_accuracy": balanced_accuracy_score(category, predicted),
        "log_loss": log_loss(category, values, labels=labels),
        "confusion": confusion_matrix(category, predicted, labels=labels).tolist(),
    }


def main() -> None:
    request = json.load(sys.stdin)
    answer = {}
    if "reference" in request:
        answer |= metrics(np.array(request["reference"], float), np.array(request["predicted"], float))
    if "ridge" in request:
        answer["ridge"] = ridge(**request["ridge"])
    for part in (distributions, contacts, categories):
        if part.__name__ in request:
            answer[part.__name__] = part(**request[part.__name__])
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
