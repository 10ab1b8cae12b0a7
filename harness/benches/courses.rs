//! Writes the courses of a dataset's first episodes. All programs in the collection benchmark then simulate the same
//! episodes.
//!
//!     cargo run --release --example courses -- --scenario cluttered --episodes 6 --output courses.bin
//!
//! The courses have the default settings. The file is in the machine's byte order. It begins with six i64: episodes,
//! samples, steps per sample, steps, position coordinates, controls. For each episode, f64 values follow: the first
//! positions `[coordinates]`, the positions at the last sample `[coordinates]`, and the controls `[steps, controls]`.
//! With the last positions, a reader can check that it simulated the same course.

use clap::Parser;
use harness::files::write_bytes;
use harness::simulation::{EpisodePlan, Scene, replay};
use harness::spec::{Simulation, World};
use std::error::Error;
use std::path::PathBuf;

#[derive(Parser)]
struct Arguments {
    /// empty or cluttered
    #[arg(long, default_value = "empty")]
    scenario: String,
    /// Number of episodes
    #[arg(long, default_value_t = 6)]
    episodes: u32,
    /// Commanded motions of the arm in an episode, 10 samples each
    #[arg(long, default_value_t = 100)]
    actuations: u32,
    /// The file to write
    #[arg(long)]
    output: PathBuf,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = Arguments::parse();
    let world = World::named(&arguments.scenario).ok_or("there is no built-in world of that name")?;
    let scene = Scene::new(world)?;
    let spec = Simulation { actuations_per_episode: arguments.actuations, ..scene.world().simulation() };
    let steps_per_sample = (1.0 / (spec.sample_rate_hz * scene.step_s())).round() as usize;
    let elements = scene.layout().action().len();
    let samples = spec.samples_per_episode();
    let steps = (samples - 1) * steps_per_sample + 1;
    let coordinates = scene.rest().len();
    let header = [arguments.episodes as usize, samples, steps_per_sample, steps, coordinates, elements];
    let mut bytes: Vec<u8> = header.iter().flat_map(|value| (*value as i64).to_ne_bytes()).collect();
    for episode in 0..arguments.episodes {
        let plan = EpisodePlan::draw(&scene, &spec, episode)?;
        let states = replay(&scene, &spec, episode)?;
        let controls = (0..steps).flat_map(|step| {
            let mut setpoint = vec![0.0; elements];
            plan.setpoint(step, &mut setpoint);
            setpoint
        });
        let values = states[0].iter().chain(&states[samples - 1]).copied().chain(controls);
        bytes.extend(values.flat_map(f64::to_ne_bytes));
    }
    write_bytes(&arguments.output, &bytes)?;
    Ok(())
}
