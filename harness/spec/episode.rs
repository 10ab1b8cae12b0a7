//! Episodes: the values that a layout describes, sample by sample. `simulation` makes them, `dataset` keeps them.

use super::modality::{Layout, Modality};
use std::fmt;
use std::sync::Arc;

/// Position (m) and orientation (unit quaternion w, x, y, z) of a box.
pub type Pose = [f64; 7];

/// What one simulation recorded: `samples` rows an array, row k at k / `sample_rate_hz` seconds.
#[derive(Clone, PartialEq)]
pub struct Episode {
    /// Its index in the dataset.
    pub index: u32,
    /// Rows of each array.
    pub samples: usize,
    /// What it holds.
    pub layout: Arc<Layout>,
    /// For each of the layout's modalities that is a stored vector its values, `[samples, elements]`.
    pub vectors: Vec<Vec<f32>>,
    /// For each of the layout's modalities that is a stored image its RGB pixels, top row first,
    /// `[samples, rows, columns, 3]`.
    pub images: Vec<Vec<u8>>,
    /// Where what is placed at random started: position (m) and orientation (unit quaternion w, x, y, z).
    pub boxes: Vec<Pose>,
    /// The OpenGL renderer that drew the frames.
    pub renderer: String,
}

impl Episode {
    /// One without values.
    pub fn new(layout: Arc<Layout>, index: u32, samples: usize) -> Self {
        let count = layout.modalities.len();
        let (vectors, images) = (vec![Vec::new(); count], vec![Vec::new(); count]);
        Self { index, samples, layout, vectors, images, boxes: Vec::new(), renderer: String::new() }
    }

    /// The values of a vector, `[samples, elements]`; empty where it is none that is stored.
    pub fn vector(&self, modality: Modality) -> &[f32] {
        self.layout.position(modality).map_or(&[], |index| &self.vectors[index])
    }

    /// The pixels of an image, `[samples, rows, columns, 3]`; empty where it is none that is stored, or none was read.
    pub fn image(&self, modality: Modality) -> &[u8] {
        self.layout.position(modality).map_or(&[], |index| &self.images[index])
    }

    /// The same without images.
    pub fn without_images(self) -> Self {
        Self { images: vec![Vec::new(); self.layout.modalities.len()], ..self }
    }
}

/// Names the episode and leaves out its megabytes.
impl fmt::Debug for Episode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut fields = f.debug_struct("Episode");
        fields.field("index", &self.index).field("samples", &self.samples).finish_non_exhaustive()
    }
}
