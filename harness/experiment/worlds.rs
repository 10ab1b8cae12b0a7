//! What worlds are like now, for the registry, which does not simulate.

use crate::collection::dataset_of;
use harness_registry::{Registry, WorldOf};
use harness_simulation::Scene;
use harness_spec::{Simulation, World};
use std::path::{Path, PathBuf};

/// Returns the results folder `root`, which need not exist yet. Of each world, the version of its file counts.
pub fn results(root: impl Into<PathBuf>) -> Registry {
    Registry::new(root).with_worlds(datasets_now)
}

/// Returns the names of the datasets that these settings give in a world as it is now.
fn datasets_now(world: &WorldOf, settings: &[&Simulation]) -> Option<Vec<String>> {
    let world = match world {
        WorldOf::BuiltIn(name) => World::named(name)?,
        WorldOf::File(path) => World::load(path).ok()?,
        WorldOf::Dataset(_) => return None,
    };
    let scene = Scene::new(world).ok()?;
    let name = |settings: &&Simulation| dataset_of(Path::new(""), &scene, settings).name().to_owned();
    Some(settings.iter().map(name).collect())
}
