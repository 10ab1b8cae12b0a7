//! Renders a short clip of each scene.

use super::cache::cached;
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use harness_figures::FigureError;
use harness_shared::progress::Progress;
use harness_simulation::{Scene, SceneRenderer, replay};
use harness_spec::{Scenario, Simulation};
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use serde::{Deserialize, Serialize};

/// Width and height of a clip's pictures, pixels.
const SIZE: [u32; 2] = [640, 400];
/// JPEG quality, %. A lower quality blurs the checks of the ground.
const QUALITY: u8 = 72;
/// Side of a block, pixels. It is a multiple of the side of a JPEG file's units, so a block looks the same in every
/// file.
const BLOCK: u32 = 16;
/// Number of samples in a clip. They are five actuations.
const SAMPLES: usize = 50;

/// The episode of a scenario's clip and the clip's first sample. Both are chosen so that the finger is pressed on
/// something.
fn take(scenario: Scenario) -> (u32, usize) {
    match scenario {
        Scenario::EMPTY => (0, 20),
        _ => (7, 60),
    }
}

/// A clip's description and its still picture, which the page shows before the clip plays.
#[derive(Serialize, Deserialize)]
pub struct Clip {
    /// The scene's scenario.
    pub scenario: Scenario,
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

/// Returns a clip of each of these scenarios of the paper. A clip that isn't in the cache is simulated and rendered.
///
/// # Errors
/// When a scene can't be simulated or rendered.
pub fn film(scenarios: &[Scenario], progress: &dyn Progress) -> Result<Vec<(Clip, Frames)>, FigureError> {
    let film = |scenario: &Scenario| {
        cached(&format!("clip-{scenario}"), || {
            progress.begin(&format!("filming {scenario}"), SAMPLES as u64, "frames");
            let clip = clip(*scenario, progress);
            progress.end();
            clip
        })
    };
    scenarios.iter().map(film).collect()
}

fn clip(scenario: Scenario, progress: &dyn Progress) -> Result<(Clip, Frames), FigureError> {
    let (episode, first) = take(scenario);
    let simulation = Simulation::default();
    let scene = Scene::paper(scenario)?;
    let mut renderer = SceneRenderer::new(&scene, SIZE[0], SIZE[1])?;
    let states = replay(&scene, &simulation, episode)?;
    let mut pictures = Vec::with_capacity(SAMPLES);
    for state in states.iter().skip(first).take(SAMPLES) {
        pictures.push(renderer.render(state)?);
        progress.advance(1);
    }
    let still = jpeg(&pictures[0])?;
    let frames: Vec<Frame> =
        pictures.iter().map(|picture| Frame::new(picture, &pictures[0])).collect::<Result<_, _>>()?;
    let samples = (first, first + frames.len() - 1);
    let clip = Clip { scenario, episode, samples, width: SIZE[0], height: SIZE[1], still };
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
