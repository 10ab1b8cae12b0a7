//! What a sample of a dataset holds: modalities, their elements and scaling, and the values of an episode.

mod episode;
mod modality;
mod name;
mod scaling;

pub use episode::{Episode, Pose};
pub use harness_yaml::is_name;
pub use modality::*;
pub use name::intern;
pub use scaling::{GivenScaling, GivenScalings, Scaling, Scalings, present, scalings_schema};
