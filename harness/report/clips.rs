//! Clips of both scenes.

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

/// Pixels.
const SIZE: [u32; 2] = [640, 400];
/// Percent. Lower ones smear the ground's checks.
const QUALITY: u8 = 72;
/// Samples of a clip: five actuations.
const SAMPLES: usize = 50;

/// What is filmed: an episode and the sample at which it begins, both so that the finger is pressed on something.
fn take(scenario: Scenario) -> (u32, usize) {
    match scenario {
        Scenario::EMPTY => (0, 20),
        _ => (7, 60),
    }
}

/// A clip as the page shows it before it plays.
#[derive(Serialize, Deserialize)]
pub struct Clip {
    pub scenario: Scenario,
    pub episode: u32,
    /// The samples that it shows, both ends included.
    pub samples: (usize, usize),
    pub width: u32,
    pub height: u32,
    /// JPEG in base64.
    pub still: String,
}

/// A clip's pictures.
#[derive(Serialize, Deserialize)]
pub struct Frames {
    scenario: Scenario,
    /// The first picture's sample.
    first: usize,
    /// How long a sample lasts.
    seconds: f64,
    /// JPEG in base64.
    frames: Vec<String>,
}

/// A clip of each scenario, simulated and rendered unless it was before.
///
/// # Errors
/// When the scene can't be simulated or rendered.
pub fn film(progress: &dyn Progress) -> Result<Vec<(Clip, Frames)>, FigureError> {
    let unreadable = |error: serde_json::Error| FigureError::Picture(error.to_string());
    let film = |scenario: &Scenario| {
        let film = cached(&format!("clip-{scenario}"), || {
            progress.begin(&format!("filming {scenario}"), SAMPLES as u64, "frames");
            let clip = clip(*scenario, progress);
            progress.end();
            serde_json::to_vec(&clip?).map_err(unreadable)
        })?;
        serde_json::from_slice(&film).map_err(unreadable)
    };
    Scenario::PAPER.iter().map(film).collect()
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
