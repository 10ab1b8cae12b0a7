//! What the simulator itself predicts: from the state at each sample, an upper bound for any model that knows as much of
//! it; or from the setpoints of a recording alone, which says how well a world matches a robot.

use super::{ExperimentError, Source};
use harness_registry::dataset::{AnyDataset, Dataset};
use harness_samples::{FramePlace, Normalizers, Sample, Samples};
use harness_shared::progress::{Progress, Silent};
use harness_simulation::{FactorValues, Knowledge, Scene, SimulatedOn, follow_setpoints, simulate_on};
use harness_spec::{
    Action, Element, Episode, Layout, Modality, RunSpec, Scale, Scaling, Scalings, Split, Window,
};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Why the simulator can't predict the samples of a task: the message.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct SimulatorError(String);

/// Simulates the outputs of `spec` at each horizon, from the state at each of the present samples `windows`, rounded to
/// f32 and as far as it is `known`. Returns `[windows, width]` in physical units, which are means over the restarts.
/// Episodes are simulated in parallel.
///
/// # Errors
/// When the dataset is not simulated, an output is not sensed, or the simulation differs from the dataset.
pub(super) fn simulated(
    source: &Source,
    spec: &RunSpec,
    samples: &Samples,
    windows: &[Sample],
    known: &Knowledge,
    progress: &dyn Progress,
) -> Result<BTreeMap<(Modality, usize), Vec<f32>>, ExperimentError> {
    let tested = source.tested();
    let (AnyDataset::Simulated(dataset), Some(scene)) = (&tested, source.tested_scene()) else {
        let message = format!(
            "{} was imported, so the state at its samples is not known; name a world that repeats its setpoints, with \
             --world WORLD",
            tested.name()
        );
        return Err(SimulatorError(message).into());
    };
    let is_sensed = |modality: &&Modality| {
        dataset.layout().stored_vectors().any(|definition| definition.name == **modality)
    };
    if let Some(&modality) = spec.output.iter().find(|modality| !is_sensed(modality)) {
        let message = format!(
            "the simulator predicts what it senses, and {modality} is an image or a change; ask for other outputs, \
             for example output=[contact_force]"
        );
        return Err(SimulatorError(message).into());
    }
    let horizons = spec.window.horizons();
    if spec.window.horizon == 0 {
        let message = "the simulator predicts from the present sample, which the task asks for; use a window.horizon of \
                       at least 1";
        return Err(SimulatorError(message.to_owned()).into());
    }
    let of_episodes: Vec<&[Sample]> =
        windows.chunk_by(|a, b| samples.place(*a).0 == samples.place(*b).0).collect();
    progress.begin("simulating", of_episodes.len() as u64, "episodes");
    let simulated = of_episodes.par_iter().map(|windows| {
        if progress.cancelled() {
            return Err(ExperimentError::Cancelled);
        }
        let episodes = simulate_from(scene, dataset, samples, windows, &horizons, known)?;
        progress.advance(1);
        Ok(episodes)
    });
    let simulated: Vec<Vec<Episode>> = simulated.collect::<Result<_, ExperimentError>>()?;
    progress.end();
    let mut values = BTreeMap::<(Modality, usize), Vec<f32>>::new();
    for episodes in &simulated {
        for (episode, &horizon) in episodes.iter().zip(&horizons) {
            for &modality in &spec.output {
                let width = dataset.layout()[modality].width();
                let values = values.entry((modality, horizon)).or_default();
                let of_samples = episode.vector(modality).chunks_exact(width * known.restarts);
                of_samples.for_each(|restarts| values.extend(mean(restarts, width)));
            }
        }
    }
    Ok(values)
}

/// Simulates on from the samples `at`, which are in one episode. Returns what is simulated at each horizon.
fn simulate_from(
    scene: &Scene,
    dataset: &Dataset,
    samples: &Samples,
    at: &[Sample],
    horizons: &[usize],
    known: &Knowledge,
) -> Result<Vec<Episode>, ExperimentError> {
    let (place, _) = samples.place(at[0]);
    let within: Vec<usize> = at.iter().map(|sample| samples.place(*sample).1).collect();
    let SimulatedOn { present, ahead } =
        simulate_on(scene, dataset.spec(), place as u32, &within, horizons, known)?;
    let is_same = |modality: Modality| {
        let stored = at.iter().flat_map(|sample| samples.vector(modality, *sample));
        present.vector(modality).iter().eq(stored)
    };
    if !samples.layout().stored_vectors().all(|definition| is_same(definition.name)) {
        let message = format!(
            "episode {place} of {} is not what the simulation gives, so it can't be simulated on from there",
            dataset.name()
        );
        return Err(SimulatorError(message).into());
    }
    Ok(ahead)
}

/// A world whose actuators repeat the setpoints of recorded episodes, from the start of each. Nothing else of a recording
/// is used.
#[derive(Clone)]
pub struct Replay {
    /// The scene of the world.
    pub scene: Arc<Scene>,
    /// The values of its factors of variation. Those that are not named have no effect.
    pub factors: BTreeMap<String, f64>,
}

/// A modality of a recording, and its columns in the world.
type Columns = (Modality, Vec<usize>);

impl Replay {
    /// Simulates the outputs of `spec` at each horizon. Returns `[windows, width]` in physical units. Setpoints and outputs
    /// are matched by the names of their elements.
    ///
    /// # Errors
    /// When the world lacks an output or moves by something else, or the simulation diverges.
    pub(super) fn predicted(
        &self,
        source: &Source,
        spec: &RunSpec,
        samples: &Samples,
        windows: &[Sample],
        progress: &dyn Progress,
    ) -> Result<BTreeMap<(Modality, usize), Vec<f32>>, ExperimentError> {
        let places: BTreeSet<usize> = windows.iter().map(|sample| samples.place(*sample).0).collect();
        let (episodes, outputs) =
            self.episodes(samples, source.tested().name(), &spec.output, &places, progress)?;
        let mut values = BTreeMap::new();
        for (modality, columns) in outputs {
            for horizon in spec.window.horizons() {
                let of_window = |sample: &Sample| {
                    let (place, within) = samples.place(*sample);
                    row(&episodes[&place], (modality, &columns), within + horizon)
                };
                values.insert((modality, horizon), windows.iter().flat_map(of_window).collect());
            }
        }
        Ok(values)
    }

    /// Simulates some episodes of a recording.
    fn episodes(
        &self,
        samples: &Samples,
        dataset: &str,
        outputs: &[Modality],
        places: &BTreeSet<usize>,
        progress: &dyn Progress,
    ) -> Result<(BTreeMap<usize, Episode>, Vec<Columns>), ExperimentError> {
        let scene = &*self.scene;
        let factors = FactorValues::given(scene, &self.factors)?;
        let setpoint = setpoint_columns(scene, samples.layout(), dataset)?;
        let of_output = |modality: &Modality| {
            Ok((*modality, output_columns(scene, samples.layout(), *modality, dataset)?))
        };
        let outputs = outputs.iter().map(of_output).collect::<Result<_, SimulatorError>>()?;
        progress.begin("simulating", places.len() as u64, "episodes");
        let rate = samples.recording().sample_rate_hz;
        let width = samples.layout().action().len();
        let follow = |place: &usize| {
            if progress.cancelled() {
                return Err(ExperimentError::Cancelled);
            }
            let range = &samples.episodes()[*place];
            let recorded = samples.setpoints()[range.start * width..range.end * width].chunks_exact(width);
            let setpoints: Vec<f64> =
                recorded.flat_map(|all| setpoint.iter().map(|column| f64::from(all[*column]))).collect();
            let episode = follow_setpoints(scene, rate, *place as u32, &factors, &setpoints)?;
            progress.advance(1);
            Ok((*place, episode))
        };
        let episodes = places.par_iter().map(follow).collect::<Result<_, ExperimentError>>()?;
        progress.end();
        Ok((episodes, outputs))
    }
}

/// The training episodes of a dataset, to which the factors of a world are fitted.
pub struct FittedTo {
    samples: Samples,
    dataset: String,
    training: Vec<Sample>,
    outputs: Vec<Modality>,
    /// The standard deviation of each element of each output.
    deviations: Vec<Vec<f32>>,
}

impl FittedTo {
    /// Reads the training samples of the dataset's own split, or all if it is too short for one.
    ///
    /// # Errors
    /// When the dataset can't be read, or lacks an output.
    pub fn open(dataset: &AnyDataset, outputs: &[&str]) -> Result<Self, ExperimentError> {
        let samples = dataset.load(FramePlace::Nowhere, &Silent)?;
        let names = || samples.layout().stored_vectors().map(|definition| definition.name);
        let output = |wanted: &&str| {
            names().find(|name| name.name() == *wanted).ok_or_else(|| {
                let there = names().map(Modality::name).collect::<Vec<_>>().join(", ");
                SimulatorError(format!("{} has no vector '{wanted}'; it has {there}", dataset.name()))
            })
        };
        let outputs = outputs.iter().map(output).collect::<Result<Vec<_>, _>>()?;
        let window = Window { horizon: 0, ..Window::TRANSITION };
        let partition = samples.partition(&samples.split(&Split::default()), &window);
        let all = || (0..samples.len()).map(Sample::at).collect();
        let training = partition.map_or_else(all, |partition| partition.training);
        let scaling = Scaling { scale: Scale::PerElement, minimum: None };
        let scalings = outputs.iter().map(|output| (*output, scaling)).collect::<Scalings>();
        let normalizers = Normalizers::fit(&samples, &training, &scalings, Action::Target);
        let deviations = outputs.iter().map(|output| normalizers.modalities[output].std.clone()).collect();
        Ok(Self { samples, dataset: dataset.name().to_owned(), training, outputs, deviations })
    }

    /// Returns by how much a replay differs from what was recorded, in standard deviations of each element: `[samples,
    /// elements]` of one output after the other.
    ///
    /// # Errors
    /// When the world lacks an output or moves by something else, or the simulation diverges.
    pub fn errors(&self, replay: &Replay) -> Result<Vec<f64>, ExperimentError> {
        let Self { samples, dataset, training, outputs, deviations } = self;
        let places: BTreeSet<usize> = training.iter().map(|sample| samples.place(*sample).0).collect();
        let (episodes, outputs) = replay.episodes(samples, dataset, outputs, &places, &Silent)?;
        let mut errors = Vec::new();
        for ((modality, columns), deviations) in outputs.iter().zip(deviations) {
            for sample in training {
                let (place, within) = samples.place(*sample);
                let simulated = row(&episodes[&place], (*modality, columns), within);
                let both = simulated.iter().zip(samples.vector(*modality, *sample)).zip(deviations);
                errors
                    .extend(both.map(|((simulated, recorded), std)| f64::from((simulated - recorded) / std)));
            }
        }
        Ok(errors)
    }
}

/// The values of an output at a sample of a simulated episode, in the order of the recording's elements.
fn row(episode: &Episode, (modality, columns): (Modality, &[usize]), sample: usize) -> Vec<f32> {
    let all = episode.vector(modality).chunks_exact(columns.len()).nth(sample).unwrap_or_default();
    columns.iter().map(|column| all[*column]).collect()
}

/// An element with its unit: `push in N`.
fn with_unit(element: &Element) -> String {
    match element.unit.as_str() {
        "" => element.name.clone(),
        unit => format!("{} in {unit}", element.name),
    }
}

/// The place of an element of `own` among `all`, by name and unit. If both have a single element, it needs no name. A unit
/// may be unknown.
fn column_of(element: &Element, own: &[Element], all: &[Element]) -> Option<usize> {
    let is_alone = own.len() == 1 && all.len() == 1;
    let has_unit =
        |other: &Element| other.unit == element.unit || other.unit.is_empty() || element.unit.is_empty();
    let is_it = |other: &Element| (other.name == element.name || is_alone) && has_unit(other);
    all.iter().position(is_it)
}

/// Returns the column of the recording's setpoint for each element of the world's action.
fn setpoint_columns(scene: &Scene, recording: &Layout, dataset: &str) -> Result<Vec<usize>, SimulatorError> {
    let own = scene.layout().action();
    let column = |element: &Element| {
        column_of(element, own, recording.action()).ok_or_else(|| {
            let there = match recording.action() {
                [] => "none".to_owned(),
                all => all.iter().map(with_unit).collect::<Vec<_>>().join(", "),
            };
            SimulatorError(format!(
                "the action of the world {} has the element {}, and the setpoints of {dataset} are {there}; name them \
                 alike, with the same units",
                scene.scenario(),
                with_unit(element)
            ))
        })
    };
    own.iter().map(column).collect()
}

/// Returns the column of the world's modality for each element of the recording's.
fn output_columns(
    scene: &Scene,
    recording: &Layout,
    modality: Modality,
    dataset: &str,
) -> Result<Vec<usize>, SimulatorError> {
    let unlike = |problem: String| {
        let world = scene.scenario();
        SimulatorError(format!(
            "the output {modality} is not in the world {world} as in {dataset}: {problem}"
        ))
    };
    let senses = || scene.layout().stored_vectors().filter(|one| one.name != Modality::SETPOINT);
    let Some(own) = senses().find(|definition| definition.name == modality) else {
        let names: Vec<&str> = senses().map(|definition| definition.name.name()).collect();
        return Err(unlike(format!("the world senses {}", names.join(", "))));
    };
    let recorded = recording[modality].elements();
    if own.width() != recorded.len() {
        return Err(unlike(format!("it has {} elements there, and {} here", own.width(), recorded.len())));
    }
    let column = |element: &Element| {
        column_of(element, recorded, own.elements()).ok_or_else(|| {
            let all = own.elements().iter().map(with_unit).collect::<Vec<_>>().join(", ");
            unlike(format!("the world has no element {}, but {all}", with_unit(element)))
        })
    };
    recorded.iter().map(column).collect()
}

/// Returns the mean of rows of `width` values.
fn mean(rows: &[f32], width: usize) -> impl Iterator<Item = f32> {
    let restarts = (rows.len() / width) as f64;
    (0..width).map(move |column| {
        let sum: f64 = rows.iter().skip(column).step_by(width).map(|value| f64::from(*value)).sum();
        (sum / restarts) as f32
    })
}
