//! The sources of samples: simulated worlds, by the names of their scenarios, and imported datasets.

use crate::layout::{interned_name, is_name};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::Path;

/// The name of a simulated world: a built-in world, or a world file, whose file name it is.
///
/// The paper's scenarios come first in every order, and all others follow in alphabetical order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Scenario(&'static str);

impl Scenario {
    /// The paper's scenario with the finger, the arm and the ground.
    pub const EMPTY: Self = Self("empty");
    /// The paper's scenario with eight movable boxes, placed at random over the sector that the arm sweeps.
    pub const CLUTTERED: Self = Self("cluttered");
    /// The two scenarios of the paper, which its figures and claims compare.
    pub const PAPER: [Self; 2] = [Self::EMPTY, Self::CLUTTERED];
}

interned_name!(Scenario, first: PAPER, refused: "can't name a scenario");

/// The source of a cell's samples. A spec gives the name of a built-in world, the path of a world file, or the name of
/// an imported dataset.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Origin {
    /// A simulated world.
    Simulated(Scenario),
    /// The path of a world file as given in a spec. In the spec of a run, it is replaced by `Simulated`.
    File(String),
    /// An imported dataset, by the name of its folder: `lab_finger-0123456789abcdef`. The digits are a hash of its
    /// content.
    Imported(String),
}

impl Origin {
    /// Returns the name in tables and file names. For a world file, it is the file name without folder and extension.
    pub fn name(&self) -> &str {
        match self {
            Self::Simulated(scenario) => scenario.name(),
            Self::File(path) => Path::new(path).file_stem().and_then(|stem| stem.to_str()).unwrap_or(path),
            Self::Imported(name) => name,
        }
    }

    /// Returns the scenario; `None` for an imported dataset, and for a file whose name is not a valid scenario.
    pub fn scenario(&self) -> Option<Scenario> {
        match self {
            Self::Simulated(scenario) => Some(*scenario),
            Self::File(_) => Scenario::new(self.name()),
            Self::Imported(_) => None,
        }
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.pad(self.name())
    }
}

impl From<Scenario> for Origin {
    fn from(scenario: Scenario) -> Self {
        Self::Simulated(scenario)
    }
}

impl From<Origin> for String {
    fn from(origin: Origin) -> Self {
        match origin {
            Origin::Simulated(scenario) => scenario.name().to_owned(),
            Origin::File(path) => path,
            Origin::Imported(name) => name,
        }
    }
}

impl TryFrom<String> for Origin {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        // A model is refused when it is read as a world file.
        if name.contains('/') || [".yaml", ".yml", ".xml"].iter().any(|ending| name.ends_with(ending)) {
            return Ok(Self::File(name));
        }
        if is_imported_name(&name) {
            return Ok(Self::Imported(name));
        }
        let scenario = Scenario::new(&name).map(Self::Simulated);
        scenario.ok_or_else(|| {
            format!(
                "'{name}' is neither a built-in world, nor the path of a world file, nor an imported dataset"
            )
        })
    }
}

/// Regular expression of the name of an imported dataset. No simulated dataset has such a name.
pub(super) const IMPORTED_NAME: &str = "^[a-z][a-z0-9_]{0,63}-[0-9a-f]{16}$";

/// Returns whether a text matches [`IMPORTED_NAME`] and does not begin with the name of a scenario of the paper.
fn is_imported_name(text: &str) -> bool {
    let Some((name, hash)) = text.rsplit_once('-') else { return false };
    is_name(name)
        && Scenario::PAPER.iter().all(|scenario| scenario.name() != name)
        && hash.len() == 16
        && hash.chars().all(|c| matches!(c, '0'..='9' | 'a'..='f'))
}
