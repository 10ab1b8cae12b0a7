//! `harness render RUN --horizon N`: what a network predicts along an episode, as a picture or a clip.

use super::progress::Bars as Progress;
use super::usage;
use anyhow::Result;
use harness::experiment::{Rollout, rollout};
use harness::figures::{Bars, Moment};
use harness::judge::picture;
use harness::numbers::counted;
use harness::progress::Progress as _;
use harness::registry::Registry;
use harness::samples::{Sample, physical};
use harness::spec::{Definition, Modality};
use image::RgbImage;
use rayon::prelude::*;

/// Which predictions are shown.
pub struct Asked<'a> {
    /// The run, as `harness ls` names it.
    pub run: &'a str,
    /// The episode; `None` for the first one that the run was tested on.
    pub episode: Option<u32>,
    /// The first predicted sample that is shown.
    pub sample: usize,
    /// The largest number of predicted samples.
    pub samples: usize,
    /// Number of samples from the present to the predicted one.
    pub horizon: usize,
}

/// Draws a frame for each predicted sample, and returns them with their number per second.
pub fn frames(registry: &Registry, asked: &Asked) -> Result<(Vec<RgbImage>, f64)> {
    let rollout = rollout(registry, asked.run, asked.episode, asked.horizon)?;
    let shown: Vec<Sample> = rollout.present.iter().map(|sample| sample.after(rollout.horizon)).collect();
    // The samples are those of one episode alone.
    let [first, last] = [shown[0], shown[shown.len() - 1]].map(Sample::index);
    let from = asked.sample.max(first);
    if from > last {
        let ahead = counted(rollout.horizon, "sample");
        return Err(usage(format!(
            "samples {first} to {last} of the episode are predicted {ahead} ahead, and not sample {from}"
        )));
    }
    let places = from - first..(last - first + 1).min(from - first + asked.samples);
    let show = Show::new(&rollout, &shown);
    let bars = Progress::default();
    bars.begin("drawing", places.len() as u64, "frames");
    let draw = |place: usize| {
        let frame = show.moment(place).draw();
        bars.advance(1);
        frame
    };
    let frames = places.into_par_iter().map(draw).collect::<Result<Vec<_>, _>>();
    bars.end();
    Ok((frames?, rollout.samples.recording().sample_rate_hz))
}

/// What the frames of an episode show.
struct Show<'a> {
    rollout: &'a Rollout,
    /// The predicted samples.
    shown: &'a [Sample],
    /// A camera's image that is not predicted, and the predicted images.
    images: Vec<Modality>,
    /// The vector whose elements are bars: a force if one is predicted.
    vector: Option<Modality>,
    /// The least and the largest recorded or predicted value of the vector.
    range: [f64; 2],
}

impl<'a> Show<'a> {
    fn new(rollout: &'a Rollout, shown: &'a [Sample]) -> Self {
        let layout = rollout.samples.layout();
        let definition = |modality: &&Modality| &layout[**modality];
        let predicted = || rollout.predicted.keys();
        let images: Vec<Modality> = predicted().filter(|name| definition(name).is_image()).copied().collect();
        let is_camera = |definition: &Definition| definition.difference_of.is_none();
        let has_camera = images.iter().any(|name| is_camera(&layout[*name]));
        let camera = layout.camera_images().next().map(|image| image.name).filter(|_| !has_camera);
        let vectors = || predicted().filter(|name| !definition(name).is_image());
        let force = vectors().find(|name| definition(name).is_force());
        let vector = force.or_else(|| vectors().next()).copied();
        let values = vector.map_or_else(Vec::new, |vector| {
            [physical(&rollout.samples, vector, shown), rollout.predicted[&vector].clone()].concat()
        });
        let ends = [values.iter().copied().fold(0.0, f32::min), values.iter().copied().fold(0.0, f32::max)];
        let images = camera.into_iter().chain(images).collect();
        Self { rollout, shown, images, vector, range: ends.map(f64::from) }
    }

    fn moment(&self, place: usize) -> Moment {
        let Rollout { samples, episode, horizon, .. } = self.rollout;
        let rate = samples.recording().sample_rate_hz;
        let seconds = |samples: usize| format!("{:.3}", samples as f64 / rate);
        let plain = |samples: usize| seconds(samples).trim_end_matches('0').trim_end_matches('.').to_owned();
        let sample = self.shown[place].index();
        Moment {
            title: format!(
                "episode {episode}, {:.1} s, predicted {} s ahead",
                sample as f64 / rate,
                plain(*horizon)
            ),
            pictures: self.images.iter().map(|image| self.pictures(*image, place)).collect(),
            bars: self.vector.map(|vector| self.bars(vector, place)),
        }
    }

    /// The recorded picture of an image and, if there is one, the predicted picture.
    fn pictures(&self, image: Modality, place: usize) -> Vec<(String, RgbImage)> {
        let (samples, definition) = (&self.rollout.samples, &self.rollout.samples.layout()[image]);
        let recorded = physical(samples, image, &self.shown[place..=place]);
        let predicted = self.rollout.predicted.get(&image).map(|values| row(values, place, self.shown.len()));
        let drawn = |values: &[f32]| {
            let [rows, columns] = definition.size()?.map(|side| side as u32);
            RgbImage::from_raw(columns, rows, picture(definition, values))
        };
        let name = image.name().replace('_', " ");
        let both = [("recorded", Some(&recorded[..])), ("predicted", predicted)];
        let titled =
            |(word, values): (&str, Option<&[f32]>)| Some((format!("{name}, {word}"), drawn(values?)?));
        both.into_iter().filter_map(titled).collect()
    }

    fn bars(&self, vector: Modality, place: usize) -> Bars {
        let (samples, definition) = (&self.rollout.samples, &self.rollout.samples.layout()[vector]);
        let predicted = row(&self.rollout.predicted[&vector], place, self.shown.len());
        let pairs = samples.vector(vector, self.shown[place]).iter().zip(predicted);
        let unit = definition.unit().filter(|unit| !unit.is_empty() && *unit != "1");
        let name = vector.name().replace('_', " ");
        Bars {
            label: unit.map_or_else(|| name.clone(), |unit| format!("{name} ({unit})")),
            values: pairs.map(|(recorded, predicted)| [*recorded, *predicted].map(f64::from)).collect(),
            range: self.range,
            is_force: definition.is_force(),
        }
    }
}

/// Returns one of the rows of a matrix.
fn row(values: &[f32], row: usize, rows: usize) -> &[f32] {
    let width = values.len() / rows;
    &values[row * width..][..width]
}
