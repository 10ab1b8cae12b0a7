"""Prints the first points of SciPy's Sobol sequence, times 2^32, as JSON: a list of coordinates for each point.

    .venv/bin/python tests/python/reference_sobol.py POINTS DIMENSIONS
"""

import json
import sys

from scipy.stats import qmc

points, dimensions = map(int, sys.argv[1:])
sequence = qmc.Sobol(dimensions, scramble=False, bits=32)
json.dump((sequence.random(points) * 2**32).astype(int).tolist(), sys.stdout)
