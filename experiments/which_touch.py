"""Chooses links of the finger that get a touch sensor, one after the other: greedy forward selection.

Each round trains one network for each link that has no sensor yet, with the sensors chosen so far and that one. The link
with the lowest validation loss of the mean force stays. No test episode is used for the choice. The rounds are the
experiments `which_touch_1`, `which_touch_2` and so on; a second call continues after the runs that are done.

    python experiments/which_touch.py --links 5 --jobs 2
"""

import argparse

import harness

LINKS = range(20)
SENSORS = ["contact_force", "contact_force_mean"]
# Short trainings on the episodes that only choose_recommended.yaml and choose_camera.yaml use.
SETTINGS = {
    "scenarios": "cluttered",
    "simulation.seed": 6,
    "simulation.episodes": 200,
    "test.episodes": 100,
    "test.seed": 6,
    "training.epochs": 10,
}
LOSSES = """
    select variant, value from epochs
    where experiment = '{}' and task = 'prediction' and split = 'validation' and term = 'contact_force_mean'
      and epoch = {}
    order by value
"""


def only(links):
    """Returns the settings of a network with sensors on these links alone."""
    return {f"inputs.{sensor}.only": links for sensor in SENSORS}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--links", type=int, default=5, help="number of sensors to choose")
    parser.add_argument("--jobs", type=int, default=1, help="number of runs to train at the same time")
    parser.add_argument("--results", default="results", help="the results folder")
    arguments = parser.parse_args()
    chosen = []
    for number in range(1, arguments.links + 1):
        name = f"which_touch_{number}"
        candidates = {f"link_{link:02}": only(sorted([*chosen, link])) for link in LINKS if link not in chosen}
        settings = {**SETTINGS, "name": name, "vary": {"links": candidates}}
        harness.run("recommended", settings, results=arguments.results, jobs=arguments.jobs)
        losses = harness.query(LOSSES.format(name, SETTINGS["training.epochs"]), results=arguments.results)
        variant, loss = losses.row(0)
        chosen.append(int(variant.rpartition("_")[2]))
        print(f"{number} sensors: links {sorted(chosen)}, validation loss {loss:.4f}")


if __name__ == "__main__":
    main()
