//! Episodes: the values of each sample, as described by a layout. `simulation` makes them and `dataset` stores them.

use super::modality::{Layout, Modality};
use std::fmt;
use std::sync::Arc;

/// Position (m) and orientation (unit quaternion w, x, y, z) of a box.
pub type Pose = [f64; 7];

/// The recording of one simulation. Each array has `samples` rows; row k is at k / `sample_rate_hz` seconds.
#[derive(Clone, PartialEq)]
pub struct Episode {
    /// Index of the episode in the dataset.
    pub index: u32,
    /// Number of samples, which is the number of rows of each array.
    pub samples: usize,
    /// The modalities that the arrays hold.
    pub layout: Arc<Layout>,
    /// One array for each modality of the layout: the values of a stored vector, `[samples, elements]`. It is empty for
    /// other modalities.
    pub vectors: Vec<Vec<f32>>,
    /// One array for each modality of the layout: the RGB pixels of a stored image, top row first,
    /// `[samples, rows, columns, 3]`. It is empty for other modalities.
    pub images: Vec<Vec<u8>>,
    /// Start poses of the boxes that are placed at random: position (m) and orientation (unit quaternion w, x, y, z).
    pub boxes: Vec<Pose>,
    /// The OpenGL renderer that drew the images.
    pub renderer: String,
}

impl Episode {
    /// Creates an episode with empty arrays.
    pub fn new(layout: Arc<Layout>, index: u32, samples: usize) -> Self {
        let count = layout.modalities.len();
        let (vectors, images) = (vec![Vec::new(); count], vec![Vec::new(); count]);
        Self { index, samples, layout, vectors, images, boxes: Vec::new(), renderer: String::new() }
    }

    /// Returns the values of a vector, `[samples, elements]`; empty if the modality is not a stored vector.
    pub fn vector(&self, modality: Modality) -> &[f32] {
        self.layout.position(modality).map_or(&[], |index| &self.vectors[index])
    }

    /// Returns the pixels of an image, `[samples, rows, columns, 3]`; empty if the modality is not a stored image, or
    /// if images were not read.
    pub fn image(&self, modality: Modality) -> &[u8] {
        self.layout.position(modality).map_or(&[], |index| &self.images[index])
    }
}

/// Prints the index and the number of samples, but not the arrays, which are large.
impl fmt::Debug for Episode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut fields = f.debug_struct("Episode");
        fields.field("index", &self.index).field("samples", &self.samples).finish_non_exhaustive()
    }
}
