//! What a sample of a dataset holds: modalities, their elements and scaling, and the values of an episode.

mod episode;
mod modality;
mod name;
mod scaling;

pub use crate::yaml::is_name;
pub use episode::{Episode, Pose};
pub use modality::*;
pub use name::intern;
pub(crate) use name::{interned_name, names};
pub use scaling::{GivenScaling, GivenScalings, Scaling, Scalings, present, scalings_schema};
