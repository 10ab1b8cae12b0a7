//! `harness render`: images and clips of a scene, an episode, or the predictions of a run.

use super::progress::Bars;
use super::rollout::{Asked, frames};
use super::table::shown;
use super::{DONE, samples, usage};
use anyhow::Result;
use clap::Args;
use harness::experiment::ModelError;
use harness::files::{WriteError, write_whole};
use harness::numbers::counted;
use harness::progress::Progress;
use harness::registry::Registry;
use harness::simulation::{EpisodePlan, Scene, SceneRenderer, replay};
use harness::spec::{self, Model, Simulation, World};
use image::codecs::gif::{GifEncoder, Repeat};
use image::{Delay, DynamicImage, Frame, ImageFormat, RgbImage};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Parses the number of samples that a network predicts ahead.
fn horizon(text: &str) -> Result<u32, String> {
    const MOST: u32 = 1000;
    samples(text).and_then(|samples| match samples {
        ..=MOST => Ok(samples),
        _ => Err(format!("it must be at most {MOST} samples")),
    })
}

#[derive(Args)]
pub struct Render {
    /// A world file, or the name of a built-in world (`harness world list` lists them). With --horizon, a run, as
    /// `harness ls` names it
    #[arg(value_name = "WORLD")]
    world: String,
    /// The image (.png) or clip (.gif) to write. A clip needs --episode to show motion
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    /// Show what the network of a run predicts this number of samples ahead, beside what was recorded: the camera, the
    /// predicted images, and the forces
    #[arg(long, value_name = "N", value_parser = horizon,
          conflicts_with_all = ["spec", "camera", "as_seen", "width", "height"])]
    horizon: Option<u32>,
    /// The episode to show, counted from 0. It is simulated again, or read from the dataset of a run [default: the
    /// scene at rest, or the first episode that a run was tested on]
    #[arg(long, value_name = "N")]
    episode: Option<u32>,
    /// The sample of the episode that an image shows, or with which a clip begins
    #[arg(long, value_name = "K", default_value_t = 0, requires = "episode")]
    sample: usize,
    /// The largest number of samples in a clip
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    samples: u32,
    /// The spec whose `simulation` settings define the episode [default: the world's default settings]
    #[arg(long, value_name = "SPEC")]
    spec: Option<PathBuf>,
    /// The camera to look through, by its name in the model [default: the world's view]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// Draw what a network gets: the image of the first camera that the world records, or of --camera, which may also
    /// be the name of a modality. The image has its recorded size and quality
    #[arg(long, conflicts_with_all = ["width", "height"])]
    as_seen: bool,
    /// Width in pixels
    #[arg(long, default_value_t = 1280)]
    width: u32,
    /// Height in pixels
    #[arg(long, default_value_t = 800)]
    height: u32,
}

/// The kind of the output, by the ending of the file's name.
#[derive(Clone, Copy)]
enum Output {
    Picture,
    Clip,
}

impl Render {
    /// Whether the command reads the results folder.
    pub fn reads_results(&self) -> bool {
        self.horizon.is_some()
    }

    /// Draws the image or clip, and writes it.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let ending = self.output.extension().unwrap_or_default().to_ascii_lowercase();
        let output = match ending.to_str() {
            Some("png") => Output::Picture,
            Some("gif") => Output::Clip,
            _ => {
                let output = self.output.display();
                return Err(usage(format!(
                    "can't write a picture to '{output}': its name must end in .png or .gif"
                )));
            }
        };
        match self.horizon {
            Some(horizon) => self.predictions(registry, horizon as usize, output)?,
            None => self.scene(registry, output)?,
        }
        println!("{}", shown(&self.output));
        Ok(ExitCode::from(DONE))
    }

    /// Draws what a network predicts.
    fn predictions(&self, registry: &Registry, horizon: usize, output: Output) -> Result<()> {
        let samples = match output {
            Output::Picture => 1,
            Output::Clip => self.samples as usize,
        };
        let (run, sample) = (self.world.as_str(), self.sample);
        let (pictures, rate) =
            frames(registry, &Asked { run, episode: self.episode, sample, samples, horizon })?;
        match output {
            Output::Picture => save(&pictures[0], &self.output)?,
            Output::Clip => self.write(pictures, rate)?,
        }
        Ok(())
    }

    /// Draws a scene or an episode.
    fn scene(&self, registry: &Registry, output: Output) -> Result<()> {
        let world = World::find(&self.world).map_err(|error| match registry.find(&self.world) {
            Ok((_, record)) => match record.spec.model {
                Model::Trained(_) => usage(format!(
                    "'{}' is a run; add --horizon 1 to show what it predicts, or name a world",
                    self.world
                )),
                Model::External(_) => ModelError::External(record.run).into(),
            },
            Err(_) => anyhow::Error::from(error),
        })?;
        let simulation = match &self.spec {
            Some(path) => world.complete(&spec::load(path, &[], false)?.simulation),
            None => world.simulation(),
        };
        let scene = Scene::new(world)?;
        let states = self.states(&scene, &simulation)?;
        let mut renderer = match (&self.camera, self.as_seen) {
            (camera, true) => SceneRenderer::as_recorded(&scene, camera.as_deref())?,
            (Some(camera), false) => SceneRenderer::from_camera(&scene, camera, self.width, self.height)?,
            (None, false) => SceneRenderer::new(&scene, self.width, self.height)?,
        };
        if let Some(episode) = self.episode {
            renderer.vary(&EpisodePlan::draw(&scene, &simulation, episode)?.factors);
        }
        match output {
            Output::Picture => save(&renderer.render(&states[0])?, &self.output)?,
            Output::Clip => self.clip(&mut renderer, &states, simulation.sample_rate_hz)?,
        }
        Ok(())
    }

    /// The positions of the episode's samples from `--sample` on, or those of the scene at rest.
    fn states(&self, scene: &Scene, simulation: &Simulation) -> Result<Vec<Vec<f64>>> {
        let mut states = match self.episode {
            Some(episode) => replay(scene, simulation, episode)?,
            None => vec![scene.rest().to_vec()],
        };
        if self.sample >= states.len() {
            let samples = counted(states.len(), "sample");
            return Err(usage(format!("the episode has {samples}, so there is no sample {}", self.sample)));
        }
        Ok(states.split_off(self.sample))
    }

    fn clip(&self, renderer: &mut SceneRenderer, states: &[Vec<f64>], sample_rate_hz: f64) -> Result<()> {
        let states = &states[..states.len().min(self.samples as usize)];
        let bars = Bars::default();
        bars.begin("drawing", states.len() as u64, "frames");
        let mut pictures = Vec::with_capacity(states.len());
        for state in states {
            pictures.push(renderer.render(state)?);
            bars.advance(1);
        }
        bars.end();
        self.write(pictures, sample_rate_hz)
    }

    /// Writes the pictures as a clip.
    fn write(&self, pictures: Vec<RgbImage>, sample_rate_hz: f64) -> Result<()> {
        let delay = Delay::from_numer_denom_ms((1000.0 / sample_rate_hz).round() as u32, 1);
        let frame = |picture| Frame::from_parts(DynamicImage::from(picture).into_rgba8(), 0, 0, delay);
        let frames: Vec<Frame> = pictures.into_iter().map(frame).collect();
        write_whole(&self.output, |file| encode(file, frames).map_err(std::io::Error::other))?;
        Ok(())
    }
}

/// Writes a picture as a PNG file.
///
/// # Errors
/// When the file can't be written.
pub fn save(picture: &RgbImage, path: &Path) -> Result<(), WriteError> {
    write_whole(path, |file| picture.save_with_format(file, ImageFormat::Png).map_err(std::io::Error::other))
}

fn encode(path: &Path, frames: Vec<Frame>) -> image::ImageResult<()> {
    let mut encoder = GifEncoder::new_with_speed(File::create(path)?, 10);
    encoder.set_repeat(Repeat::Infinite)?;
    encoder.encode_frames(frames)
}
