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
    /// The pictures: JPEG files in base64.
    frames: Vec<String>,
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
    let mut frames = Vec::with_capacity(SAMPLES);
    for state in states.iter().skip(first).take(SAMPLES) {
        frames.push(jpeg(&renderer.render(state)?)?);
        progress.advance(1);
    }
    let still = frames.first().cloned().unwrap_or_default();
    let samples = (first, first + frames.len().saturating_sub(1));
    let clip = Clip { scenario, episode, samples, width: SIZE[0], height: SIZE[1], still };
    Ok((clip, Frames { scenario, first, seconds: 1.0 / simulation.sample_rate_hz, frames }))
}

fn jpeg(picture: &RgbImage) -> Result<String, FigureError> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, QUALITY)
        .encode_image(picture)
        .map_err(|error| FigureError::Picture(error.to_string()))?;
    Ok(BASE64.encode(bytes))
}
