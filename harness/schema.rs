//! The columns of every table, with units and meanings: the writers, the queries, the documents and
//! `harness schema` all read them here.

use serde::Serialize;

/// One column of a table.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Column {
    pub name: String,
    pub unit: &'static str,
    pub meaning: String,
}

/// The tables that can be queried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Table {
    /// One row a run, whether it succeeded or not.
    Runs,
    /// One row an epoch and loss term.
    Epochs,
    /// One row a metric.
    Metrics,
    /// One row a test sample and joint or link.
    Predictions,
    /// One row a recorded sample, without the frames.
    Episodes,
}

/// A name for each degree of freedom of the arm, and its unit.
pub const ARM: [(&str, &str); 3] = [("rotation", "rad"), ("lift", "m"), ("extension", "m")];

impl Table {
    pub const ALL: [Table; 5] =
        [Table::Runs, Table::Epochs, Table::Metrics, Table::Predictions, Table::Episodes];

    /// The table's name in queries.
    pub fn name(self) -> &'static str {
        match self {
            Table::Runs => "runs",
            Table::Epochs => "epochs",
            Table::Metrics => "metrics",
            Table::Predictions => "predictions",
            Table::Episodes => "episodes",
        }
    }

    /// What a row is.
    pub fn meaning(self) -> &'static str {
        match self {
            Table::Runs => "one row a run, whether it succeeded or not",
            Table::Epochs => "one row an epoch, split and loss term",
            Table::Metrics => "one row a metric of a run or of a baseline on the same test samples",
            Table::Predictions => "one row a test sample and joint or link",
            Table::Episodes => "one row a recorded sample; the files hold the frames besides",
        }
    }

    /// The table's columns, in order.
    pub fn columns(self) -> Vec<Column> {
        match self {
            Table::Runs => [run_key(), run_details()].concat(),
            Table::Epochs => [run_key(), epoch_values()].concat(),
            Table::Metrics => [run_key(), metric_values()].concat(),
            Table::Predictions => [run_key(), prediction_values()].concat(),
            Table::Episodes => sample_columns(),
        }
    }
}

fn column(name: &str, unit: &'static str, meaning: &str) -> Column {
    Column { name: name.to_owned(), unit, meaning: meaning.to_owned() }
}

/// What tells one run from another; the first columns of every table of runs.
fn run_key() -> Vec<Column> {
    vec![
        column("experiment", "", "name of the experiment"),
        column("run", "", "run id: scenario, latent size, seed and the first digits of the spec's hash"),
        column("scenario", "", "empty or cluttered"),
        column("input", "", "modalities given to the encoder, joined by +"),
        column("output", "", "modalities predicted, joined by +"),
        column("architecture", "", "fully_connected or convolutional"),
        column("latent", "1", "size of the latent state"),
        column("seed", "", "seed of the run"),
    ]
}

fn run_details() -> Vec<Column> {
    vec![
        column("status", "", "running, done or failed"),
        column("reason", "", "why a run failed; null otherwise"),
        column("spec_hash", "", "hash of everything that decides the run"),
        column("dataset", "", "the dataset's folder"),
        column("started", "", "start, UTC"),
        column("collect_seconds", "s", "wall time spent on collecting and loading the dataset"),
        column("prediction_seconds", "s", "wall time of training the prediction"),
        column("reconstruction_seconds", "s", "wall time of training the reconstruction; null without one"),
        column("evaluation_seconds", "s", "wall time of the metrics"),
        column("peak_memory_bytes", "B", "largest memory of the process up to the end of the run"),
        column("parameters", "1", "trained parameters of the prediction"),
        column("git_commit", "", "commit of the source tree; null outside one"),
        column("git_dirty", "", "whether the source tree had uncommitted changes; null outside one"),
        column("harness_version", "", "version of this program"),
        column("mujoco_version", "", "version of MuJoCo"),
        column("candle_version", "", "version of candle"),
        column("host", "", "name of the machine"),
        column("processor", "", "the machine's processor"),
        column("threads", "1", "threads used"),
        column("command", "", "the command line"),
    ]
}

fn epoch_values() -> Vec<Column> {
    vec![
        column("task", "", "prediction or reconstruction"),
        column("epoch", "1", "counted from 1"),
        column("split", "", "train or validation"),
        column("term", "", "total, kl, or the mean squared error of a modality"),
        column("value", "1", "mean of the term over the split, on standardised values, before weighting"),
        column("seconds", "s", "wall time of the epoch"),
    ]
}

fn metric_values() -> Vec<Column> {
    vec![
        column("task", "", "prediction or reconstruction"),
        column("model", "", "network, or a baseline: persistence, training_mean, ridge"),
        column("modality", "", "what is predicted"),
        column("direction", "", "flexion_extension or adduction_abduction; null where neither or both"),
        column("index", "1", "joint or link, 0 at the base; null for an aggregate"),
        column("metric", "", "smape, wmape, r2, rmse, mae or relative_error"),
        column("value", "", "the metric; null where it is not defined"),
        column("unit", "", "unit of the value"),
    ]
}

fn prediction_values() -> Vec<Column> {
    vec![
        column("task", "", "prediction or reconstruction"),
        column("modality", "", "proprioception, contact_force or contact_force_mean"),
        column("episode", "1", "episode of the dataset"),
        column("sample", "1", "the instant that is predicted, counted from 0 within its episode"),
        column("index", "1", "joint or link, 0 at the base"),
        column("reference", "rad or N", "the simulation's value"),
        column("predicted", "rad or N", "the network's value"),
    ]
}

/// The scalar columns of an episode file, in order; the frames' column follows them there.
pub fn sample_columns() -> Vec<Column> {
    let mut columns = vec![
        column("dataset", "", "the dataset's folder"),
        column("scenario", "", "empty or cluttered"),
        column("episode", "1", "episode of the dataset"),
        column("sample", "1", "counted from 0 within the episode"),
        column("time", "s", "simulated time since the episode's start"),
    ];
    let per_link = |name: &str, unit, meaning: &str| -> Vec<Column> {
        (0..crate::spec::JOINTS)
            .map(|index| column(&format!("{name}_{index:02}"), unit, &format!("{meaning} {index}")))
            .collect()
    };
    columns.extend(per_link("proprioception", "rad", "angle of finger joint"));
    for (name, unit) in ARM {
        columns.push(column(&format!("arm_{name}"), unit, &format!("{name} of the arm")));
    }
    for (name, unit) in ARM {
        columns.push(column(&format!("setpoint_{name}"), unit, &format!("commanded {name} of the arm")));
    }
    columns.extend(per_link("contact_force", "N", "normal contact force, at the instant, on link"));
    columns.extend(per_link(
        "contact_force_mean",
        "N",
        "normal contact force, averaged over the interval up to the instant, on link",
    ));
    columns
}

/// The column of an episode file that holds the camera frames.
pub fn frame_column() -> Column {
    column("vision", "", "camera frame, 64 x 64 x 3 bytes: rows from the top, pixels from the left, RGB")
}
