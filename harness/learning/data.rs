//! A dataset as tensors for a network: what it gets, and what it should predict.

use super::observation::{Keeping, Observation, Value};
use candle_core::{DType, Device, Result, Tensor};
use harness_ops::frames::{Images, SampleFrames};
use harness_ops::{Values, input};
use harness_samples::{FramesError, Normalizers, Sample, Samples, physical};
use harness_spec::{Action, Disturbances, Modality};
use std::collections::{BTreeMap, btree_map::Entry};
use std::sync::{Arc, Mutex};

/// A dataset, normalized for a network.
#[derive(Clone)]
pub struct NormalizedData {
    /// The samples, in physical units.
    pub samples: Arc<Samples>,
    /// Means and standard deviations of the modalities and of the action.
    pub normalizers: Arc<Normalizers>,
    /// Which quantity is used as the action.
    pub action: Action,
    /// The device on which tensors are created.
    pub device: Device,
    /// The inputs that a network gets, and their name in the tables; `None` for all that it has.
    given: Option<(Vec<Modality>, &'static str)>,
    /// What a network gets if its sensors are disturbed.
    seen: Option<Arc<Self>>,
    /// What is copied to the device once.
    tables: Arc<Mutex<BTreeMap<Table, Tensor>>>,
    /// The images of all samples, on a GPU.
    images: Images,
}

/// What lies on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Table {
    /// The normalized vectors of all samples, `[samples, width]`.
    Vectors(Modality),
    /// The actions after all samples, `[samples, elements]`.
    Actions,
    /// The factors that turn a change in units of the values' deviation into a normalized one, `[width]`.
    Change(Modality),
}

impl NormalizedData {
    /// Normalizes `samples`, whose `action` the network gets, for a network on `device`.
    pub fn new(samples: Arc<Samples>, normalizers: Arc<Normalizers>, action: Action, device: Device) -> Self {
        let (tables, images) = (Arc::default(), Images::default());
        Self { samples, normalizers, action, device, given: None, seen: None, tables, images }
    }

    /// Returns the same data for a network that gets only these of its inputs, which tables call `name`.
    pub fn giving(&self, inputs: Vec<Modality>, name: &'static str) -> Self {
        Self { given: Some((inputs, name)), ..self.clone() }
    }

    /// Returns the same data for a network whose sensors are disturbed, and have no other disturbances. `purpose` names
    /// the random streams; see [`Samples::disturbed`].
    ///
    /// # Errors
    /// When frames can't be written to disk.
    pub fn disturbed(&self, inputs: &Disturbances, purpose: &str) -> std::result::Result<Self, FramesError> {
        if inputs.is_empty() {
            return Ok(Self { seen: None, ..self.clone() });
        }
        let Self { samples, normalizers, action, device, .. } = self.clone();
        let samples = Arc::new(samples.disturbed(inputs, &normalizers, purpose)?);
        let seen = Some(Arc::new(Self::new(samples, normalizers, action, device)));
        Ok(Self { seen, ..self.clone() })
    }

    /// Returns the samples as a network's sensors give them.
    pub fn sensed(&self) -> &Arc<Samples> {
        &self.seen().samples
    }

    fn seen(&self) -> &Self {
        self.seen.as_deref().unwrap_or(self)
    }

    /// Returns what tables call the inputs that a network gets; `None` for all that it has.
    pub fn given(&self) -> Option<&'static str> {
        self.given.as_ref().map(|(_, name)| *name)
    }

    fn is_given(&self, modality: Modality) -> bool {
        self.given.as_ref().is_none_or(|(inputs, _)| inputs.contains(&modality))
    }

    /// Returns the same data for a network on another device.
    pub fn on(&self, device: Device) -> Self {
        let seen = self.seen.as_ref().map(|seen| Arc::new(seen.on(device.clone())));
        let on_device = Self::new(self.samples.clone(), self.normalizers.clone(), self.action, device);
        Self { given: self.given.clone(), seen, ..on_device }
    }

    /// Returns the same data for a network that predicts changes of `modalities`, until `horizon` samples after each of
    /// the samples in `present`.
    pub fn predicting_changes(
        &self,
        modalities: impl Iterator<Item = Modality>,
        present: &[Sample],
        horizon: usize,
    ) -> Self {
        let normalizers = self.normalizers.with_changes(&self.samples, present, modalities, horizon);
        Self { normalizers: Arc::new(normalizers), ..self.clone() }
    }

    /// Returns the same data for a network whose predicted quantiles are recalibrated by `levels`.
    pub fn recalibrated(&self, levels: BTreeMap<Modality, Vec<f32>>) -> Self {
        let normalizers = Normalizers { levels, ..(*self.normalizers).clone() };
        Self { normalizers: Arc::new(normalizers), ..self.clone() }
    }

    /// Returns what a network should predict at the samples `at`, each of which follows one in `present`: the values of
    /// `modalities`, or their changes since what it got at `present`, where windows may lack inputs.
    pub fn targets(
        &self,
        at: &[Sample],
        present: &[Sample],
        keeping: &Keeping,
        modalities: &[Modality],
    ) -> Result<Observation> {
        let changes = &self.normalizers.changes;
        let (changed, valued): (Vec<Modality>, Vec<Modality>) =
            modalities.iter().partition(|modality| changes.contains_key(modality));
        let values = self.observation(at, &valued)?;
        let change = |modality: Modality| {
            let given = self.inputs(present, &[modality])?.keeping(keeping)?.vectors(&[modality])?;
            let change = (self.vectors(at, modality)? - given)?;
            let factors = self.table(Table::Change(modality), || {
                let ratios = &self.normalizers.change_ratios()[&modality];
                Tensor::from_vec(
                    ratios.iter().map(|ratio| ratio.recip()).collect(),
                    ratios.len(),
                    &self.device,
                )
            })?;
            Ok((modality, Value::Vector(change.broadcast_mul(&factors)?)))
        };
        let changes = changed.into_iter().map(change).collect::<Result<Vec<_>>>()?;
        Ok(values.into_iter().chain(changes).collect())
    }

    /// Returns what a network with these inputs gets at the samples `at`, normalized. An input that is not given is at
    /// its mean over the training data.
    pub fn inputs(&self, at: &[Sample], inputs: &[Modality]) -> Result<Observation> {
        let missing = inputs.iter().filter(|modality| !self.is_given(**modality));
        let kept = missing.map(|modality| (*modality, vec![0.0])).collect();
        self.seen().observation(at, inputs)?.keeping(&kept)
    }

    /// Returns the values of a modality that a network gets at the samples `at`, in physical units, `[at, width]`.
    pub fn given_values(&self, modality: Modality, at: &[Sample]) -> Vec<f32> {
        let mut values = physical(self.sensed(), modality, at);
        if !self.is_given(modality) {
            values.fill(0.0);
            self.normalizers.modalities[&modality].denormalize(&mut values);
        }
        values
    }

    /// Returns the normalized values of `modalities` at the samples `at`.
    pub fn observation(&self, at: &[Sample], modalities: &[Modality]) -> Result<Observation> {
        let value = |&modality: &Modality| {
            let images = (!self.device.is_cpu()).then_some(&self.images);
            let value = match SampleFrames::new(&self.samples, &self.normalizers, at, modality, images) {
                Some(frames) => Value::Frames(Arc::new(frames)),
                None => Value::Vector(self.vectors(at, modality)?),
            };
            Ok((modality, value))
        };
        modalities.iter().map(value).collect()
    }

    /// Returns the normalized values of a vector, `[batch, width]`.
    fn vectors(&self, at: &[Sample], modality: Modality) -> Result<Tensor> {
        if self.device.is_cpu() {
            return self.matrix(self.normalizers.vectors(&self.samples, at, &[modality]), at.len());
        }
        self.rows(at, Table::Vectors(modality), || {
            let mut values = self.samples.vectors(modality).to_vec();
            self.normalizers.modalities[&modality].normalize(&mut values);
            self.matrix(values, self.samples.len())
        })
    }

    /// Returns rows of a table, which is made if there is none.
    fn rows(&self, at: &[Sample], table: Table, make: impl FnOnce() -> Result<Tensor>) -> Result<Tensor> {
        let indices = Values::U32(indices(at));
        self.table(table, make)?.index_select(&input(indices, at.len(), &self.device)?, 0)
    }

    /// Returns a table, which is made if there is none.
    fn table(&self, table: Table, make: impl FnOnce() -> Result<Tensor>) -> Result<Tensor> {
        let mut tables = self.tables.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        Ok(match tables.entry(table) {
            Entry::Occupied(table) => table.get().clone(),
            Entry::Vacant(place) => place.insert(make()?).clone(),
        })
    }

    /// Returns `values` as a matrix of `rows` rows.
    fn matrix(&self, values: Vec<f32>, rows: usize) -> Result<Tensor> {
        let columns = values.len() / rows;
        Tensor::from_vec(values, (rows, columns), &self.device)
    }

    /// Returns the normalized actions, `[batch, elements]`, between each sample in `at` and the next one. Without a
    /// setpoint, these are `[batch, 1]` zeros, which no network takes.
    pub fn actions(&self, at: &[Sample]) -> Result<Tensor> {
        if self.samples.layout().action().is_empty() {
            return Tensor::zeros((at.len(), 1), DType::F32, &self.device);
        }
        let actions =
            |at: &[Sample]| self.matrix(self.normalizers.actions(&self.samples, at, self.action), at.len());
        if self.device.is_cpu() {
            return actions(at);
        }
        self.rows(at, Table::Actions, || {
            actions(&(0..self.samples.len()).map(Sample::at).collect::<Vec<_>>())
        })
    }
}

/// Returns the positions of samples.
pub(crate) fn indices(at: &[Sample]) -> Vec<u32> {
    at.iter().map(|sample| sample.index() as u32).collect()
}
