//! What a network sees of a batch of samples, and what it should predict: normalized values by modality.

use candle_core::{Device, Result, Tensor};
use harness_ops::frames::{Frames, Kept, stacked};
use harness_ops::{Values, input};
use harness_spec::Modality;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The normalized values of one modality for a batch.
#[derive(Clone)]
pub enum Value {
    /// A vector, `[batch, width]`.
    Vector(Tensor),
    /// An image, with three channels.
    Frames(Arc<dyn Frames>),
}

/// For each modality that some windows lack, 1 for a window that has it and 0 for one that lacks it.
pub type Keeping = BTreeMap<Modality, Vec<f32>>;

/// The normalized values of a batch by modality. A modality without values was not given.
#[derive(Clone, Default)]
pub struct Observation {
    values: BTreeMap<Modality, Value>,
    /// For each modality that some rows lack, 1 for a row that has it and 0 for one that lacks it.
    kept: Keeping,
}

impl FromIterator<(Modality, Value)> for Observation {
    fn from_iter<I: IntoIterator<Item = (Modality, Value)>>(values: I) -> Self {
        Self { values: values.into_iter().collect(), kept: Keeping::new() }
    }
}

impl IntoIterator for Observation {
    type Item = (Modality, Value);
    type IntoIter = std::collections::btree_map::IntoIter<Modality, Value>;

    fn into_iter(self) -> Self::IntoIter {
        self.values.into_iter()
    }
}

impl Observation {
    /// Returns the values of a modality; `None` if it was not given.
    pub fn get(&self, modality: Modality) -> Option<&Value> {
        self.values.get(&modality)
    }

    /// Returns the observation in which a modality is at its mean, which is normalized to 0, where a window lacks it.
    /// The rows of the windows at one time lie together.
    pub fn keeping(mut self, keeping: &Keeping) -> Result<Self> {
        for (modality, kept) in keeping {
            let Some(value) = self.values.get_mut(modality) else { continue };
            let rows = match &*value {
                Value::Vector(vector) => vector.dim(0)?,
                Value::Frames(frames) => frames.batch(),
            };
            let of_rows: Vec<f32> = kept.iter().copied().cycle().take(rows).collect();
            *value = match &*value {
                Value::Vector(vector) => {
                    let kept = input(Values::F32(of_rows.clone()), (rows, 1), vector.device())?;
                    Value::Vector(vector.broadcast_mul(&kept)?)
                }
                Value::Frames(frames) => Value::Frames(Arc::new(Kept::new(frames.clone(), of_rows.clone()))),
            };
            let all = self.kept.entry(*modality).or_insert_with(|| vec![1.0; rows]);
            all.iter_mut().zip(of_rows).for_each(|(all, kept)| *all *= kept);
        }
        Ok(self)
    }

    /// Returns which rows have at least one of these modalities, `[batch, 1]`: 1 for a row that has one, and 0 for one
    /// that lacks all. `None` if each row has one.
    pub fn kept(&self, modalities: &[Modality], device: &Device) -> Result<Option<Tensor>> {
        let kept: Option<Vec<&Vec<f32>>> =
            modalities.iter().map(|modality| self.kept.get(modality)).collect();
        let Some(kept) = kept.filter(|kept| !kept.is_empty()) else { return Ok(None) };
        let rows = kept[0].len();
        let most = |row: usize| kept.iter().map(|kept| kept[row]).fold(0.0, f32::max);
        input(Values::F32((0..rows).map(most).collect()), (rows, 1), device).map(Some)
    }

    /// Returns these vectors side by side, `[batch, width]`.
    pub fn vectors(&self, modalities: &[Modality]) -> Result<Tensor> {
        let vector = |modality: &Modality| match self.get(*modality) {
            Some(Value::Vector(vector)) => Ok(vector.clone()),
            _ => candle_core::bail!("the observation lacks the vector '{modality}'"),
        };
        let mut vectors = modalities.iter().map(vector).collect::<Result<Vec<_>>>()?;
        if vectors.len() == 1 { Ok(vectors.remove(0)) } else { Tensor::cat(&vectors, 1) }
    }

    /// Returns these images stacked by channel.
    pub fn frames(&self, modalities: &[Modality]) -> Result<Arc<dyn Frames>> {
        let frames = |modality: &Modality| match self.get(*modality) {
            Some(Value::Frames(frames)) => Ok(frames.clone()),
            _ => candle_core::bail!("the observation lacks the image '{modality}'"),
        };
        Ok(stacked(modalities.iter().map(frames).collect::<Result<_>>()?))
    }
}
