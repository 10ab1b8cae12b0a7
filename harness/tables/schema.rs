//! The columns of every table, with units and meanings. Writers, queries, documents and `harness schema` use this list.

use harness_spec::{LabelKind, Layout, Modality};
use serde::Serialize;
use std::borrow::Cow;

/// One column of a table.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Column {
    /// Name of the column.
    pub name: String,
    /// Type of the values.
    pub kind: Kind,
    /// SI unit; "1" for a count or a ratio, empty if there is no unit.
    pub unit: Cow<'static, str>,
    /// Description for people.
    pub meaning: String,
}

/// The type of a column's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// UTF-8 text.
    Text,
    /// Whole number, 64 bits.
    Integer,
    /// Floating-point number, 64 bits.
    Real,
    /// True or false.
    Flag,
    /// Binary data.
    Bytes,
}

/// The tables that can be queried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Table {
    /// One row for each run, whether it succeeded or not.
    Runs,
    /// One row for each epoch, split and loss term.
    Epochs,
    /// One row for each metric.
    Metrics,
    /// Like [`Table::Metrics`], and also for later samples and for models that got only some inputs.
    AllMetrics,
    /// One row for each metric and test episode.
    Sums,
    /// One row for each test sample and joint or link.
    Predictions,
    /// Like [`Table::Predictions`], and also for later samples and for models that got only some inputs.
    AllPredictions,
    /// One row for each link and force, over the whole dataset or one episode.
    Forces,
    /// One row for each image of a few test samples.
    Frames,
    /// One row for each recorded sample, without the images.
    Episodes,
}

impl Table {
    /// All tables.
    pub const ALL: [Table; 10] = [
        Table::Runs,
        Table::Epochs,
        Table::Metrics,
        Table::AllMetrics,
        Table::Sums,
        Table::Predictions,
        Table::AllPredictions,
        Table::Forces,
        Table::Frames,
        Table::Episodes,
    ];

    /// Returns the table's name in queries.
    pub fn name(self) -> &'static str {
        match self {
            Table::Runs => "runs",
            Table::Epochs => "epochs",
            Table::Metrics => "metrics",
            Table::AllMetrics => "all_metrics",
            Table::Sums => "sums",
            Table::Predictions => "predictions",
            Table::AllPredictions => "all_predictions",
            Table::Forces => "forces",
            Table::Frames => "frames",
            Table::Episodes => "episodes",
        }
    }

    /// Returns the name of the file that holds a run's rows. For [`Table::AllMetrics`] and [`Table::AllPredictions`],
    /// the file holds the rows that the table [`Table::usual`] has not.
    pub fn file_name(self) -> String {
        let name = match self {
            Table::AllMetrics => "further_metrics",
            Table::AllPredictions => "further_predictions",
            _ => self.name(),
        };
        format!("{name}.parquet")
    }

    /// Returns the table whose rows are a part of this table's rows: those of the nearest sample that a task predicts,
    /// by models that got all inputs. It lacks the columns [`HORIZON`] and [`GIVEN`].
    pub fn usual(self) -> Option<Table> {
        match self {
            Table::AllMetrics => Some(Table::Metrics),
            Table::AllPredictions => Some(Table::Predictions),
            _ => None,
        }
    }

    /// Returns a description of the rows.
    pub fn meaning(self) -> &'static str {
        match self {
            Table::Runs => "one row for each run, whether it succeeded or not",
            Table::Epochs => "one row for each epoch, split and loss term",
            Table::Metrics => "one row for each metric of a run, or of a baseline on the same test samples",
            Table::AllMetrics => {
                "the rows of metrics, those of samples further ahead, and those of models that got only some inputs"
            }
            Table::Sums => {
                "one row for each metric and test episode: two sums that the metric is computed from"
            }
            Table::Predictions => "one row for each test sample and joint or link",
            Table::AllPredictions => {
                "the rows of predictions, those of samples further ahead, and those of models that got only some inputs"
            }
            Table::Forces => {
                "one row for each link and force: its distribution over the run's dataset, or over one of its episodes"
            }
            Table::Frames => "one row for each image: what the network predicts for a few fixed test samples",
            Table::Episodes => "one row for each recorded sample; the files have the images too",
        }
    }

    /// Returns the table's columns, in order.
    pub fn columns(self) -> Vec<Column> {
        match self {
            Table::Runs => [run_key(), run_details()].concat(),
            Table::Epochs => [run_key(), epoch_values()].concat(),
            Table::Metrics => [run_key(), metric_values()].concat(),
            Table::AllMetrics => [run_key(), metric_values(), distance()].concat(),
            Table::Sums => [run_key(), sum_values()].concat(),
            Table::Predictions => [run_key(), prediction_values()].concat(),
            Table::AllPredictions => [run_key(), prediction_values(), distance()].concat(),
            Table::Forces => [run_key(), force_values()].concat(),
            Table::Frames => [run_key(), frame_values()].concat(),
            Table::Episodes => sample_columns(&Layout::finger()),
        }
    }
}

fn column(name: &str, kind: Kind, unit: &'static str, meaning: &str) -> Column {
    Column { name: name.to_owned(), kind, unit: unit.into(), meaning: meaning.to_owned() }
}

fn text(name: &str, meaning: &str) -> Column {
    column(name, Kind::Text, "", meaning)
}

fn integer(name: &str, meaning: &str) -> Column {
    column(name, Kind::Integer, "1", meaning)
}

fn real(name: &str, unit: &'static str, meaning: &str) -> Column {
    column(name, Kind::Real, unit, meaning)
}

/// Returns the columns that identify a run. They are the first columns of every table of runs.
fn run_key() -> Vec<Column> {
    vec![
        text("experiment", "name of the experiment"),
        text("run", "run id: scenario, latent size, seed and the first digits of the spec's hash"),
        text("scenario", "empty, cluttered, the name of a world file, or the name of an imported dataset"),
        text("input", "modalities given to the encoder, joined by +"),
        text("output", "modalities predicted, joined by +"),
        text(
            "architecture",
            "the preset of the network, single_to_multi or multi_to_multi, or the name of a model of another program",
        ),
        integer("latent", "size of the latent state; null for a model of another program"),
        text("variant", "settings that the experiment varies, such as kl_weight=0.001; empty if none"),
        integer("seed", "seed of the run"),
    ]
}

fn run_details() -> Vec<Column> {
    vec![
        text("status", "running, interrupted, done or failed"),
        text("reason", "why a run failed; null otherwise"),
        text("spec_hash", "hash of everything that determines the run"),
        text(
            "group_hash",
            "hash of everything that determines the run except its seed; runs with the same hash form a group",
        ),
        text("dataset", "the dataset's folder"),
        text("test_dataset", "the folder of the dataset that only the test uses; null if the run has none"),
        integer("dataset_seed", "seed of the dataset; the fold of a recording, or null without folds"),
        text("world_version", "version of the simulated world; null if it was imported, or is not known"),
        text("reading", "the reading of the paper; null if the experiment has none"),
        text(
            "role",
            "the label of the axis `role`, by which claims compare readings; null if there is no such axis",
        ),
        text(
            "split",
            "what is divided into training, validation and test: episode, time, or sample. With sample, test samples \
             have neighbors in training, and errors are too small",
        ),
        text("started", "start, UTC"),
        real(
            "collect_seconds",
            "s",
            "wall time of collecting and loading the dataset, which all runs of a command on this dataset share",
        ),
        real(
            "prediction_seconds",
            "s",
            "wall time of training the prediction; null for a model of another program",
        ),
        real(
            "reconstruction_seconds",
            "s",
            "wall time of training the reconstruction; null if it was not trained",
        ),
        real("evaluation_seconds", "s", "wall time of the metrics"),
        column(
            "peak_memory_bytes",
            Kind::Integer,
            "B",
            "largest memory of the process up to the end of the run",
        ),
        integer(
            "parameters",
            "number of trained parameters of the prediction; null for a model of another program",
        ),
        text("git_commit", "commit of the source tree; null outside of a repository"),
        column(
            "git_dirty",
            Kind::Flag,
            "",
            "whether the source tree had uncommitted changes; null outside of a repository",
        ),
        text("harness_version", "version of this program"),
        text("mujoco_version", "version of MuJoCo"),
        text("candle_version", "version of candle"),
        text("host", "name of the machine"),
        text("processor", "the machine's processor"),
        integer("threads", "threads used"),
        text("command", "the command line, reduced to this run"),
        text(
            "task_hash",
            "hash of what the run asks of a model: dataset, split, inputs, outputs, action and window",
        ),
        text(
            "notes",
            "what the user of a model of another program says about it, as JSON; null for a network",
        ),
    ]
}

fn epoch_values() -> Vec<Column> {
    vec![
        text("task", "prediction or reconstruction"),
        integer("epoch", "counted from 1"),
        text("split", "train or validation"),
        text("term", "total, kl, or the modality whose loss it is"),
        real("value", "1", "mean of the term over the split, on normalized values, before weighting"),
        real("seconds", "s", "wall time of the epoch"),
    ]
}

/// Name of the column with the number of samples from the present to the predicted one.
pub const HORIZON: &str = "horizon";
/// Name of the column with the modalities that a model got.
pub const GIVEN: &str = "given";

fn distance() -> Vec<Column> {
    vec![
        integer(HORIZON, "number of samples from the present to the predicted one; 0 for the present one"),
        text(
            GIVEN,
            "the modalities that the model got, joined by a comma; null if it got all of the run's input",
        ),
    ]
}

/// Name of the column that tells networks of this program from models of other programs and baselines.
pub const TRAINED_HERE: &str = "trained_here";

fn metric_values() -> Vec<Column> {
    vec![
        text("task", "prediction or reconstruction"),
        text(
            "model",
            "network; a baseline: persistence, training_mean, ridge, nearest_neighbors; or the name of a model of another program",
        ),
        column(
            TRAINED_HERE,
            Kind::Flag,
            "",
            "whether this program trained the model: true for a network, false for a baseline and for a model of \
             another program",
        ),
        text("modality", "what is predicted; 'latent' for the rows of kl and active"),
        text(
            "direction",
            "group of elements, such as the finger's fe (flexion/extension) and aa (adduction/abduction); 'in rad', \
             'in m' and so on for the elements with a unit, if a modality has several; the category, or 'ball as book' \
             for balls that are predicted as books; null if none or all",
        ),
        integer(
            "index",
            "element: joint or link, 0 at the base, category, or dimension of the latent state; null for an aggregate",
        ),
        text(
            "metric",
            "smape, wmape, r2, rmse, mae, relative_error; relative_error_arm, relative_error_finger and those of other \
             regions: over the pixels that show the region before or after the change; r2_ground, mae_none and those \
             of other kinds of contact: over the links with such a contact; crps_onset and others of a phase of a contact: over the links in \
             it; r2_from_10s and others of window.since_s: \
             over the samples from that time of their episode on; kl: the divergence of the latent state, or of one of \
             its dimensions, from what is expected before the present sample, averaged over the test windows; active: \
             the number of dimensions whose kl is above 0.01 nats; log_r2, trimmed_r2, f1, auc, crps, coverage_90, \
             width_90, pit_0 and so on: see docs/metrics.md; accuracy, balanced_accuracy, log_loss and confusion of \
             categories; angle of unit vectors; or a user's metric",
        ),
        real("value", "", "the metric; null if it is not defined"),
        text("unit", "unit of the value"),
    ]
}

fn sum_values() -> Vec<Column> {
    let mut columns = vec![
        text("task", "prediction or reconstruction"),
        text("model", "as in metrics"),
        text("modality", "what is predicted"),
        text(
            "direction",
            "'in rad', 'in m' and so on for the elements with a unit, if a modality has several; null for all elements",
        ),
        text(
            "metric",
            "a metric of metrics that is computed from the ratio of two sums: 1 minus it (r2, r2_ground), 100 times it \
             (smape, wmape), its root (rmse), or itself (mae, relative_error, accuracy, log_loss, angle)",
        ),
    ];
    columns.extend(distance());
    columns.extend([
        integer("episode", "episode of the dataset that has the test episodes"),
        real(
            "numerator",
            "",
            "sum of the errors in the episode, to 0.05 %: absolute for mae and wmape, squared for rmse and r2; for \
             accuracy, the number of samples that are predicted right",
        ),
        real(
            "denominator",
            "",
            "what the sum of the numerators of all episodes is divided by, as far as it is of this episode: the number \
             of values, or the sum of their absolute references or squared deviations from the mean of the test",
        ),
    ]);
    columns
}

fn prediction_values() -> Vec<Column> {
    vec![
        text("task", "prediction or reconstruction"),
        text("modality", "a vector whose elements have one unit, such as proprioception"),
        integer("episode", "episode of the dataset"),
        integer("sample", "the predicted sample, counted from 0 within its episode"),
        integer("index", "element: joint or link, 0 at the base"),
        real("reference", "", "the simulated value, in the modality's unit"),
        real("predicted", "", "the predicted value, in the modality's unit"),
    ]
}

fn force_values() -> Vec<Column> {
    let mut columns = vec![
        text("modality", "a vector of forces, such as contact_force"),
        integer("episode", "episode of the dataset; null for the whole dataset"),
        integer("index", "link, 0 at the base"),
        integer("samples", "number of samples in the episode or dataset"),
        integer(
            "contacts",
            "number of samples in which the link is touched, so that its force is not 0; with sensor noise, all",
        ),
        real("mean", "N", "mean force over all samples, touched or not"),
    ];
    columns.extend(harness_metrics::contact::QUANTILES.iter().map(|(name, share)| {
        let meaning =
            format!("quantile {share} of the force over the samples in contact; null if there are none");
        real(name, "N", &meaning)
    }));
    columns.push(real("max", "N", "largest force in contact; null if the link is never touched"));
    columns
}

fn frame_values() -> Vec<Column> {
    let picture = |name: &str, whose: &str| {
        let meaning = format!(
            "{whose} image, rows x columns x 3 bytes: rows from the top, pixels from the left, RGB. An image has its \
             intensity times 255, and a difference has 128 plus the difference times 127"
        );
        column(name, Kind::Bytes, "", &meaning)
    };
    vec![
        text("task", "prediction or reconstruction"),
        text("modality", "an image, such as vision or frame_difference"),
        integer("episode", "episode of the dataset"),
        integer("sample", "the sample of the image, counted from 0 within its episode"),
        real("motion", "1", "mean absolute change of the camera image during the transition, in [0, 1]"),
        picture("reference", "the simulated"),
        picture("predicted", "the predicted"),
    ]
}

/// Returns the scalar columns of an episode file, in order. The columns of the images follow them in the file.
pub fn sample_columns(layout: &Layout) -> Vec<Column> {
    let mut columns = vec![
        text("dataset", "the dataset's folder"),
        text("scenario", "empty, cluttered, the name of a world file, or the name of an imported dataset"),
        integer("episode", "episode of the dataset"),
        integer("sample", "counted from 0 within the episode"),
        real("time", "s", "time since the episode's start"),
    ];
    columns.extend(layout.labels.iter().map(|label| Column {
        name: label.name.clone(),
        kind: match label.kind {
            LabelKind::Text => Kind::Text,
            LabelKind::Integer => Kind::Integer,
            LabelKind::Real => Kind::Real,
        },
        unit: "".into(),
        meaning: "label of the episode".into(),
    }));
    for definition in layout.stored_vectors() {
        columns.extend(definition.columns().zip(definition.elements()).map(|(name, element)| Column {
            name,
            kind: Kind::Real,
            unit: element.unit.clone().into(),
            meaning: format!("{} {}", definition.meaning, element.name),
        }));
    }
    columns
}

/// Returns the columns of an episode file that hold images.
pub fn image_columns(layout: &Layout) -> Vec<Column> {
    let of = |(name, [rows, columns]): (Modality, [usize; 2])| {
        let meaning =
            format!("image, {rows} x {columns} x 3 bytes: rows from the top, pixels from the left, RGB");
        column(name.name(), Kind::Bytes, "", &meaning)
    };
    layout.stored_images().filter_map(|image| Some((image.name, image.size()?))).map(of).collect()
}
