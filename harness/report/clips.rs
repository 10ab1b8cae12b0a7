//! Renders a short clip of each scene.

use super::Asked;
use super::cache::cached;
use super::subjects::is_of_the_paper;
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use harness_analysis::Analysis;
use harness_figures::FigureError;
use harness_registry::Registry;
use harness_shared::progress::Progress;
use harness_simulation::{EpisodePlan, Scene, SceneRenderer, SimulationError, replay};
use harness_spec::{Layout, Origin, Scenario, Simulation, World};
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::Arc;

/// Width and height of a clip's pictures, pixels.
const SIZE: [u32; 2] = [640, 400];
/// JPEG quality, %. A lower quality blurs the checks of the ground.
const QUALITY: u8 = 72;
/// Side of a block, pixels. It is a multiple of the side of a JPEG file's units, so a block looks the same in every
/// file.
const BLOCK: u32 = 16;
/// Number of samples in a clip. They are five actuations.
const SAMPLES: usize = 50;

/// Number of samples in a clip of another world, whose speed of rendering is unknown.
const FEW_SAMPLES: usize = 30;

/// A world that is filmed.
pub struct Shot {
    /// The world's name.
    pub scenario: Scenario,
    /// The world's file; `None` for a built-in world.
    file: Option<PathBuf>,
    /// The file of the model with which the dataset was simulated, which older datasets lack; `None` for a scene of the
    /// paper.
    model: Option<PathBuf>,
    /// The settings of the simulation.
    simulation: Simulation,
    /// The modalities of the runs' samples; `None` for a scene of the paper, which needs no runs.
    layout: Option<Arc<Layout>>,
}

impl Shot {
    /// A scene of the paper.
    pub fn of_the_paper(scenario: Scenario) -> Self {
        Self { scenario, file: None, model: None, simulation: Simulation::default(), layout: None }
    }

    /// The worlds of the asked experiments that are none of the paper's scenes.
    pub fn others(analysis: &Analysis, asked: &Asked) -> Vec<Self> {
        let mut shots: Vec<Self> = Vec::new();
        for run in asked.experiments.iter().flat_map(|name| analysis.runs(name)) {
            let record = &run.record;
            let Origin::Simulated(scenario) = record.spec.scenario else { continue };
            let Some(simulation) = record.spec.simulation.clone() else { continue };
            let file = record.provenance.world_file.clone();
            let is_known = |shot: &Shot| shot.scenario == scenario && shot.file == file;
            if !is_of_the_paper(&record.spec.scenario) && !shots.iter().any(is_known) {
                let model = Some(Registry::new(analysis.root()).model(&record.dataset));
                shots.push(Self { scenario, file, model, simulation, layout: Some(record.layout.clone()) });
            }
        }
        shots
    }

    /// Compiles the world.
    fn scene(&self) -> Result<Scene, FigureError> {
        let world = match &self.file {
            Some(file) => World::load(file),
            None => World::find(self.scenario.name()),
        };
        let world = world.map_err(SimulationError::from)?;
        let stored = self.model.as_ref().and_then(|path| Some((std::fs::read_to_string(path).ok()?, path)));
        let scene = match stored {
            Some((xml, path)) => Scene::from_xml(world, &xml, path.display().to_string())?,
            None => Scene::new(world)?,
        };
        let is_changed =
            self.layout.as_ref().is_some_and(|layout| *layout != scene.layout_of(&self.simulation));
        match is_changed {
            true => Err(FigureError::Picture("its modalities have changed since the runs".into())),
            false => Ok(scene),
        }
    }

    /// The episode, its first sample and the number of samples of the clip. Those of the paper's scenes are chosen so
    /// that the finger is pressed on something.
    fn take(&self) -> (u32, usize, usize) {
        match (&self.layout, self.scenario) {
            (Some(_), _) => (0, 0, FEW_SAMPLES.min(self.simulation.samples_per_episode())),
            (None, Scenario::EMPTY) => (0, 20, SAMPLES),
            (None, _) => (7, 60, SAMPLES),
        }
    }
}

/// A clip's description and its still picture, which the page shows before the clip plays.
#[derive(Serialize, Deserialize)]
pub struct Clip {
    /// The scene's scenario.
    pub scenario: Scenario,
    /// Whether it is one of the paper's scenes.
    pub is_of_the_paper: bool,
    /// The description of the world.
    pub description: String,
    /// The episode that the clip shows.
    pub episode: u32,
    /// The first and the last sample that the clip shows.
    pub samples: (usize, usize),
    /// Width of the pictures, pixels.
    pub width: u32,
    /// Height of the pictures, pixels.
    pub height: u32,
    /// The first picture: a JPEG file in base64.
    pub still: String,
}

/// A clip's pictures, which the page's script plays.
#[derive(Serialize, Deserialize)]
pub struct Frames {
    scenario: Scenario,
    /// The sample of the first picture.
    first: usize,
    /// The time from one sample to the next, s.
    seconds: f64,
    /// What differs from the first picture, for each picture.
    frames: Vec<Frame>,
}

/// The part of a picture that differs from the first one. The camera stands still, so it is small.
#[derive(Serialize, Deserialize)]
struct Frame {
    /// The changed blocks: their numbers, row by row from the upper left corner.
    blocks: Vec<u32>,
    /// The changed blocks side by side, in rows as wide as a picture: a JPEG file in base64.
    picture: String,
}

/// Films a world. The clips of the paper's scenes are kept in the cache.
///
/// # Errors
/// When the world can't be read, simulated or rendered.
pub fn film(shot: &Shot, progress: &dyn Progress) -> Result<(Clip, Frames), FigureError> {
    let film = || {
        progress.begin(&format!("filming {}", shot.scenario), shot.take().2 as u64, "frames");
        let clip = clip(shot, progress);
        progress.end();
        clip
    };
    match shot.layout {
        None => cached(&format!("clip-{}", shot.scenario), film),
        Some(_) => film(),
    }
}

fn clip(shot: &Shot, progress: &dyn Progress) -> Result<(Clip, Frames), FigureError> {
    let ((episode, first, count), scenario) = (shot.take(), shot.scenario);
    let (scene, simulation) = (shot.scene()?, &shot.simulation);
    let mut renderer = SceneRenderer::new(&scene, SIZE[0], SIZE[1])?;
    renderer.vary(&EpisodePlan::draw(&scene, simulation, episode)?.factors);
    let states = replay(&scene, simulation, episode)?;
    let mut pictures = Vec::with_capacity(count);
    for state in states.iter().skip(first).take(count) {
        pictures.push(renderer.render(state)?);
        progress.advance(1);
    }
    let still = jpeg(&pictures[0])?;
    let frames: Vec<Frame> =
        pictures.iter().map(|picture| Frame::new(picture, &pictures[0])).collect::<Result<_, _>>()?;
    let samples = (first, first + frames.len() - 1);
    let is_of_the_paper = shot.layout.is_none();
    let (description, [width, height]) = (scene.world().description().to_owned(), SIZE);
    let clip = Clip { scenario, is_of_the_paper, description, episode, samples, width, height, still };
    Ok((clip, Frames { scenario, first, seconds: 1.0 / simulation.sample_rate_hz, frames }))
}

impl Frame {
    fn new(picture: &RgbImage, first: &RgbImage) -> Result<Self, FigureError> {
        let columns = SIZE[0] / BLOCK;
        let corner = |block: u32| [block % columns * BLOCK, block / columns * BLOCK];
        let at = |picture: &RgbImage, block| {
            let [x, y] = corner(block);
            image::imageops::crop_imm(picture, x, y, BLOCK, BLOCK).to_image()
        };
        let all = 0..columns * (SIZE[1] / BLOCK);
        let blocks: Vec<u32> = all.filter(|block| at(picture, *block) != at(first, *block)).collect();
        let rows = (blocks.len() as u32).div_ceil(columns).max(1);
        let mut packed = RgbImage::new(SIZE[0], rows * BLOCK);
        for (place, block) in (0..).zip(&blocks) {
            let [x, y] = corner(place);
            image::imageops::replace(&mut packed, &at(picture, *block), x.into(), y.into());
        }
        Ok(Self { picture: jpeg(&packed)?, blocks })
    }
}

fn jpeg(picture: &RgbImage) -> Result<String, FigureError> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, QUALITY)
        .encode_image(picture)
        .map_err(|error| FigureError::Picture(error.to_string()))?;
    Ok(BASE64.encode(bytes))
}
