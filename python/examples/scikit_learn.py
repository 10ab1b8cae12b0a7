"""Judges a random forest, k-nearest neighbors and a multi-layer perceptron on a task: scikit_learn.py SPEC [SEEDS]

Images are reduced to 16 x 16 gray values. Only vectors are predicted.
"""

import sys
import time

import numpy as np
import sklearn
from sklearn.ensemble import RandomForestRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import harness

MODELS = {
    "random_forest": lambda seed: RandomForestRegressor(max_features="sqrt", min_samples_leaf=2, random_state=seed),
    "k_nearest_neighbors": lambda seed: make_pipeline(StandardScaler(), KNeighborsRegressor(10, weights="distance")),
    "mlp": lambda seed: make_pipeline(
        StandardScaler(), MLPRegressor(hidden_layer_sizes=(128, 128), early_stopping=True, random_state=seed)
    ),
}


def flat(context, actions):
    """Returns everything that a model gets about each window as one row."""
    parts = [actions, *context.values()]
    for place, part in enumerate(parts):
        if part.ndim == 5:
            parts[place] = part.mean(-1).reshape(*part.shape[:2], 16, -1, 16, part.shape[3] // 16).mean((3, 5))
    return np.concatenate([part.reshape(len(part), -1) for part in parts], 1)


def main(spec, seeds=3):
    task = harness.task(spec)
    context, actions, targets = task.train()[:]
    steps = np.array(task.horizons) - 1
    scales = {name: targets[name].std() for name in task.output}
    scaled = (targets[name][:, steps] / scales[name] for name in task.output)
    wanted = np.concatenate([part.reshape(len(part), -1) for part in scaled], 1)
    widths = [len(steps) * task.shapes[name][0] for name in task.output]
    for name, create in MODELS.items():
        for seed in range(seeds):
            start = time.time()
            model = create(seed).fit(flat(context, actions), wanted)
            def predict(context, actions, model=model):
                parts = np.split(model.predict(flat(context, actions)), np.cumsum(widths)[:-1], 1)
                shaped = (part.reshape(len(part), len(steps), -1) for part in parts)
                return {output: part * scales[output] for output, part in zip(task.output, shaped)}

            notes = {"scikit-learn": sklearn.__version__, "seconds": round(time.time() - start, 1)}
            task.submit(predict, model=name, seed=seed, notes=notes)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
