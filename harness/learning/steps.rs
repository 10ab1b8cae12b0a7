//! Training steps: the loss of a batch, its gradients, and a step of Adam. On a GPU, steps of the same kind are
//! repeated as one recorded graph.

use super::network::Draw;
use super::objective::{Objective, Weighted};
use super::random::Random;
use candle_core::{Result, Tensor};
use harness_metrics::epoch::TOTAL;
use harness_ops::Adam;
use harness_samples::Sample;

/// The losses of a batch.
pub(super) struct StepLosses {
    /// Names of the terms, and [`TOTAL`].
    pub names: Vec<String>,
    /// Their values, `[names]`.
    pub values: Tensor,
}

impl StepLosses {
    /// Returns the values of the terms and of their weighted sum, and this sum as a scalar with its gradient.
    pub fn of(terms: &[Weighted]) -> Result<(Self, Tensor)> {
        let mut total: Option<Tensor> = None;
        for term in terms {
            // A multiplication by 1 would only add work to the backward pass.
            let value = if term.weight == 1.0 { term.value.clone() } else { (&term.value * term.weight)? };
            total = Some(match total {
                Some(total) => (total + value)?,
                None => value,
            });
        }
        let Some(total) = total else { candle_core::bail!("a loss without terms") };
        let values: Vec<Tensor> =
            terms.iter().map(|term| &term.value).chain([&total]).map(Tensor::detach).collect();
        let names = terms.iter().map(|term| term.name.clone()).chain([TOTAL.to_owned()]).collect();
        Ok((Self { names, values: Tensor::stack(&values, 0)? }, total))
    }
}

/// Takes the steps of a training.
pub(super) struct Steps<'a> {
    pub objective: &'a dyn Objective,
    pub adam: Adam,
    dropout: f64,
    #[cfg(feature = "cuda")]
    repeated: repeated::Repeated,
}

impl<'a> Steps<'a> {
    pub fn new(objective: &'a dyn Objective, adam: Adam, dropout: f64) -> Self {
        Self {
            objective,
            adam,
            dropout,
            #[cfg(feature = "cuda")]
            repeated: repeated::Repeated::default(),
        }
    }

    /// Takes a step on the windows whose present samples are `at`. Returns the losses before it.
    /// `missing` supplies which inputs a window lacks.
    pub fn take(&mut self, at: &[Sample], random: &mut Random, missing: &mut Random) -> Result<StepLosses> {
        #[cfg(feature = "cuda")]
        if let Some(device) = self.adam.gpu() {
            return self.take_on_gpu(&device, at, random, missing);
        }
        self.take_by_itself(at, random, missing)
    }

    fn take_by_itself(
        &mut self,
        at: &[Sample],
        random: &mut Random,
        missing: &mut Random,
    ) -> Result<StepLosses> {
        let terms = self.objective.terms(at, Draw::Sample { random, dropout: self.dropout, missing })?;
        let (losses, total) = StepLosses::of(&terms)?;
        self.adam.step(&total.backward()?)?;
        Ok(losses)
    }
}

/// Steps on a GPU that are repeated as a graph.
#[cfg(feature = "cuda")]
mod repeated {
    use super::{StepLosses, Steps};
    use crate::objective::Objective;
    use crate::random::Random;
    use candle_core::{Device, Result};
    use harness_ops::graph::{Graph, Input, first_run};
    use harness_ops::{Adam, Dropout, Values};
    use harness_samples::Sample;

    /// Where an input of a step comes from.
    pub enum Source {
        /// So many standard normal numbers. They are drawn after the seed of a dropout that changes nothing if
        /// `after_seed`: that of a network without images.
        Noise { len: usize, after_seed: bool },
        /// The key of the dropout.
        Dropout,
        /// One of the lists of rows with these indices, which were all equal in the first step.
        Rows(Vec<usize>),
        /// The optimizer.
        Adam,
    }

    impl Source {
        /// Whether these lists of rows leave no doubt about the input.
        fn is_certain(&self, lists: &[Vec<u32>]) -> bool {
            match self {
                Self::Rows(equal) => equal.iter().all(|list| lists[*list] == lists[equal[0]]),
                _ => true,
            }
        }
    }

    /// The steps of one batch size that are repeated.
    #[derive(Default)]
    pub enum Repeated {
        #[default]
        Nothing,
        /// A step of this batch size was taken. Its inputs come from these sources.
        Once { batch: usize, inputs: Vec<Input>, sources: Vec<Source>, losses: StepLosses },
        /// Steps of this batch size are recorded.
        Graph { batch: usize, graph: Graph, sources: Vec<Source>, names: Vec<String> },
        /// The inputs of this objective's steps are not known before.
        Impossible,
    }

    impl Steps<'_> {
        pub(super) fn take_on_gpu(
            &mut self,
            device: &Device,
            at: &[Sample],
            random: &mut Random,
            missing: &mut Random,
        ) -> Result<StepLosses> {
            match std::mem::take(&mut self.repeated) {
                Repeated::Nothing => self.first(device, at, random, missing),
                Repeated::Once { batch, inputs, sources, losses } if batch == at.len() => {
                    let steps = self.adam.steps();
                    let (mut own, mut lacking) = (random.clone(), missing.clone());
                    let recorded = Graph::record(device, inputs, losses.values.copy()?, || {
                        Ok(self.take_by_itself(at, &mut own, &mut lacking)?.values)
                    });
                    self.adam.set_steps(steps);
                    match recorded {
                        Ok(graph) => {
                            self.repeated = Repeated::Graph { batch, graph, sources, names: losses.names };
                            self.take_on_gpu(device, at, random, missing)
                        }
                        Err(_) => {
                            self.repeated = Repeated::Impossible;
                            self.take_by_itself(at, random, missing)
                        }
                    }
                }
                Repeated::Graph { batch, graph, sources, names } if batch == at.len() => {
                    let lists = self.objective.indices(at)?;
                    if !sources.iter().all(|source| source.is_certain(&lists)) {
                        self.repeated = Repeated::Impossible;
                        return self.take_by_itself(at, random, missing);
                    }
                    let adam = self.adam.count();
                    let inputs = sources.iter().map(|source| match source {
                        Source::Noise { len, after_seed } => {
                            if *after_seed {
                                random.seed();
                            }
                            Values::F32(random.normal(*len))
                        }
                        Source::Dropout => Values::U32(Dropout::new(self.dropout, random.seed()).key()),
                        Source::Rows(equal) => Values::U32(lists[equal[0]].clone()),
                        Source::Adam => adam.clone(),
                    });
                    let values = graph.repeat(&inputs.collect::<Vec<_>>())?;
                    let losses = StepLosses { names: names.clone(), values };
                    self.repeated = Repeated::Graph { batch, graph, sources, names };
                    Ok(losses)
                }
                // The last batch of an epoch may be smaller.
                other => {
                    self.repeated = other;
                    self.take_by_itself(at, random, missing)
                }
            }
        }

        /// Takes a step, and finds out where its inputs come from.
        fn first(
            &mut self,
            device: &Device,
            at: &[Sample],
            random: &mut Random,
            missing: &mut Random,
        ) -> Result<StepLosses> {
            let (before, mut losses) = (random.clone(), None);
            let (_, inputs) = first_run(device, || {
                let taken = self.take_by_itself(at, random, missing)?;
                let values = taken.values.clone();
                losses = Some(taken);
                Ok(values)
            })?;
            let Some(losses) = losses else { candle_core::bail!("a step without losses") };
            let found = sources(&inputs, self.objective, &self.adam, self.dropout, at, before)?;
            self.repeated = match found {
                Some(sources) => Repeated::Once {
                    batch: at.len(),
                    inputs,
                    sources,
                    losses: StepLosses { names: losses.names.clone(), values: losses.values.clone() },
                },
                None => Repeated::Impossible,
            };
            Ok(losses)
        }
    }

    /// Returns where the inputs of a step came from, which began with the generator `random`. `None` if that of one of
    /// them is not known.
    fn sources(
        inputs: &[Input],
        objective: &dyn Objective,
        adam: &Adam,
        dropout: f64,
        at: &[Sample],
        mut random: Random,
    ) -> Result<Option<Vec<Source>>> {
        let (lists, of_adam) = (objective.indices(at)?, adam.input());
        let mut sources = Vec::with_capacity(inputs.len());
        for Input { values, .. } in inputs {
            let mut later = random.clone();
            let source = match values {
                _ if *values == of_adam => Source::Adam,
                Values::F32(noise) => {
                    let mut after = random.clone();
                    after.seed();
                    let at_once = later.normal(noise.len()) == *noise;
                    if !at_once && after.normal(noise.len()) != *noise {
                        return Ok(None);
                    }
                    random = if at_once { later } else { after };
                    Source::Noise { len: noise.len(), after_seed: !at_once }
                }
                Values::U32(rows) => {
                    let equal: Vec<usize> = (0..lists.len()).filter(|list| lists[*list] == *rows).collect();
                    if !equal.is_empty() {
                        Source::Rows(equal)
                    } else if Dropout::new(dropout, later.seed()).key() == *rows {
                        random = later;
                        Source::Dropout
                    } else {
                        return Ok(None);
                    }
                }
            };
            sources.push(source);
        }
        Ok(Some(sources))
    }
}
