//! Trains and judges the networks of one run.

use crate::{ExperimentError, OpenData, PreparedData};
use harness_judge::{MetricRow, Predictor, Test, judge, models};
use harness_learning::data::NormalizedData;
use harness_learning::levels::levels;
use harness_learning::network::description::Description;
use harness_learning::network::{Architecture, Decoder, Network, Parameters, Score, architecture};
use harness_learning::objective::{Objective, Prediction, Reconstruction};
use harness_learning::predict::{Latents, TrainedDecoder, TrainedNetwork};
use harness_learning::random::{Random, Stream};
use harness_learning::state::StateFile;
use harness_learning::training::Fit;
use harness_learning::{self as learning, LearningError, checkpoint};
use harness_metrics::latent;
use harness_registry::dataset::DatasetError;
use harness_registry::{Claimed, LiveEpochs, Outcome, Timings};
use harness_samples::Normalizers;
use harness_shared::progress::Progress;
use harness_spec::{Given, Recalibration, RunSpec, Task, Trained};
use std::time::Instant;

/// One run that is being trained.
pub(super) struct TrainingRun<'a> {
    pub spec: &'a RunSpec,
    pub trained: &'a Trained,
    pub claimed: &'a Claimed<'a>,
    pub prepared: &'a PreparedData,
    /// The prepared data on the run's own device. Runs that are trained at once do not share a GPU's queue.
    pub data: NormalizedData,
    pub progress: &'a dyn Progress,
    /// Shows the epochs to other processes while the run is trained.
    pub epochs: LiveEpochs<'a>,
}

impl TrainingRun<'_> {
    pub fn run(&self) -> Result<Outcome, ExperimentError> {
        let references = &self.prepared.references;
        let mut outcome = Outcome {
            timings: Timings { collect: self.prepared.seconds, ..Timings::default() },
            ..Outcome::default()
        };
        outcome.extend(references.baselines.clone());
        outcome.forces = references.forces.clone();
        let (network, parameters) = self.predict(&mut outcome)?;
        outcome.parameters = parameters.values().map(|var| var.elem_count()).sum();
        if self.spec.tasks.contains(&Task::Reconstruction) {
            self.reconstruct(&*network, &mut outcome)?;
        }
        Ok(outcome)
    }

    /// Trains and evaluates the network that predicts.
    fn predict(&self, outcome: &mut Outcome) -> Result<(Box<dyn Network>, Parameters), ExperimentError> {
        let (spec, data) = (self.spec, &self.data);
        let begin = Instant::now();
        let task = Task::Prediction;
        let mut parameters = Parameters::new();
        let mut random = Random::new(spec.seed, Stream::Parameters(task));
        let architecture =
            architecture(spec, self.trained, data.samples.layout(), task).scaled(&data.normalizers);
        let network = architecture.network(&mut parameters, &mut random, &data.device);
        let objective = Prediction {
            data,
            network: network.map_err(LearningError::from)?,
            window: &spec.window,
            input: &spec.input,
            output: &spec.output,
            training: &self.trained.training,
            score: Score::Loss,
        };
        self.train(task, &architecture, &objective, &parameters, outcome)?;
        let network = objective.network;
        let training = &self.trained.training;
        let data = match training.recalibration {
            Recalibration::Quantiles => {
                let validation = &self.prepared.open.partition.validation;
                &data.recalibrated(levels(
                    &self.predictor(&*network, data, 0),
                    &training.distributions,
                    validation,
                )?)
            }
            Recalibration::None | Recalibration::Scales => data,
        };
        self.save(task, &architecture, &parameters, &data.normalizers)?;
        outcome.timings.prediction = begin.elapsed().as_secs_f64();
        for data in std::iter::once(Ok(data.clone())).chain(self.tests(data)) {
            let data = data?;
            let trained = self.predictor(&*network, &data, self.trained.network.draws);
            self.judge(task, &trained, outcome)?;
            let begin = Instant::now();
            let test = &self.prepared.open.partition.test;
            let divergences = trained.divergences(test).map_err(LearningError::from)?;
            let (model, given) = (trained.name().to_owned(), trained.given());
            let horizon = spec.window.first_horizon();
            let row = |row| MetricRow { task, model: model.clone(), horizon, given, row };
            outcome.metrics.extend(latent::rows(&divergences).into_iter().map(row));
            outcome.timings.evaluation += begin.elapsed().as_secs_f64();
        }
        Ok((network, parameters))
    }

    /// Returns a trained network as a predictor for these data, with this number of drawn latent states.
    fn predictor<'b>(
        &'b self,
        network: &dyn Network,
        data: &'b NormalizedData,
        draws: usize,
    ) -> TrainedNetwork<'b> {
        let RunSpec { input, output, window, seed, .. } = self.spec;
        TrainedNetwork { data, network: network.detached(), input, output, window, draws, seed: *seed }
    }

    /// Returns the data of each test besides that with all inputs.
    ///
    /// The data are made when they are needed, because disturbed images may be large.
    fn tests(&self, data: &NormalizedData) -> impl Iterator<Item = Result<NormalizedData, ExperimentError>> {
        let data = |given: &Given| {
            let data = data.giving(given.inputs(), given.name());
            match given {
                Given::Disturbed(inputs) => data.disturbed(inputs, "test").map_err(DatasetError::from),
                _ => Ok(data),
            }
        };
        self.spec.given.iter().map(move |given| Ok(data(given)?))
    }

    /// Trains and evaluates a new decoder on the latent states of the frozen network.
    fn reconstruct(&self, network: &dyn Network, outcome: &mut Outcome) -> Result<(), ExperimentError> {
        let (spec, data) = (self.spec, &self.data);
        let begin = Instant::now();
        let task = Task::Reconstruction;
        let output = spec.reconstructed();
        let mut parameters = Parameters::new();
        let latents = Latents::of(network, data, &spec.input, &spec.window).map_err(LearningError::from)?;
        let architecture = architecture(spec, self.trained, data.samples.layout(), task);
        let decoder = self.new_decoder(&architecture, &mut parameters)?;
        let objective = Reconstruction { data, latents: &latents, decoder, output: &output };
        self.train(task, &architecture, &objective, &parameters, outcome)?;
        self.save(task, &architecture, &parameters, &data.normalizers)?;
        outcome.timings.reconstruction = Some(begin.elapsed().as_secs_f64());
        let decoder = objective.decoder.detached();
        let name = models::NETWORK;
        self.judge(
            task,
            &TrainedDecoder { name, data, latents: &latents, decoder, output: &output },
            outcome,
        )?;
        for data in self.tests(data) {
            let data = data?;
            let begin = Instant::now();
            let latents = Latents::of(network, &data, &spec.input, &spec.window);
            let latents = latents.map_err(LearningError::from)?;
            outcome.timings.evaluation += begin.elapsed().as_secs_f64();
            let decoder = objective.decoder.detached();
            let trained = TrainedDecoder { name, data: &data, latents: &latents, decoder, output: &output };
            self.judge(task, &trained, outcome)?;
        }
        if spec.probes.is_empty() { Ok(()) } else { self.probe_untrained(&architecture, outcome) }
    }

    /// Trains and evaluates the decoder of the reconstruction on the latent states of an encoder that is not trained:
    /// what it tells of the probes is not learned from the prediction.
    fn probe_untrained(&self, decoding: &Architecture, outcome: &mut Outcome) -> Result<(), ExperimentError> {
        let (spec, data, task) = (self.spec, &self.data, Task::Reconstruction);
        let encoding = architecture(spec, self.trained, data.samples.layout(), Task::Prediction);
        let mut random = Random::new(spec.seed, Stream::Untrained);
        let network =
            encoding.scaled(&data.normalizers).network(&mut Parameters::new(), &mut random, &data.device);
        let network = network.map_err(LearningError::from)?;
        let latents = Latents::of(&*network, data, &spec.input, &spec.window).map_err(LearningError::from)?;
        let mut parameters = Parameters::new();
        let decoder = self.new_decoder(decoding, &mut parameters)?;
        let output = spec.reconstructed();
        let objective = Reconstruction { data, latents: &latents, decoder, output: &output };
        self.fit(task, &StateFile::none(), &|_| ()).run(&objective, &parameters)?;
        let (name, decoder) = (models::UNTRAINED, objective.decoder.detached());
        let trained = TrainedDecoder { name, data, latents: &latents, decoder, output: &spec.probes };
        self.judge(task, &trained, outcome)
    }

    /// Returns the decoder of the reconstruction with its initial parameters.
    fn new_decoder(
        &self,
        architecture: &Architecture,
        parameters: &mut Parameters,
    ) -> Result<Box<dyn Decoder>, ExperimentError> {
        let mut random = Random::new(self.spec.seed, Stream::Parameters(Task::Reconstruction));
        let decoder = architecture.decoder(parameters, &mut random, &self.data.device);
        Ok(decoder.map_err(LearningError::from)?)
    }

    /// Returns a training for a task.
    fn fit<'b>(
        &'b self,
        task: Task,
        state: &'b StateFile,
        log: &'b dyn Fn(&[learning::training::Epoch]),
    ) -> Fit<'b> {
        Fit {
            task,
            training: &self.trained.training,
            seed: self.spec.seed,
            partition: &self.prepared.open.partition,
            state,
            progress: self.progress,
            log,
        }
    }

    /// Trains `parameters` on an objective. Adds the losses to the outcome.
    fn train(
        &self,
        task: Task,
        architecture: &Architecture,
        objective: &dyn Objective,
        parameters: &Parameters,
        outcome: &mut Outcome,
    ) -> Result<(), ExperimentError> {
        let state = StateFile::at(self.claimed.state(task));
        let log = |epochs: &[learning::training::Epoch]| self.epochs.set(task, epochs);
        let fit = self.fit(task, &state, &log);
        let epochs = fit.run(objective, parameters)?;
        if self.trained.training.recalibration != Recalibration::None {
            fit.recalibrate(objective, parameters, architecture).map_err(LearningError::from)?;
        }
        outcome.epochs.extend(epochs.into_iter().map(|epoch| (task, epoch)));
        Ok(())
    }

    /// Saves a trained network for values that are normalized so.
    fn save(
        &self,
        task: Task,
        architecture: &Architecture,
        parameters: &Parameters,
        normalizers: &Normalizers,
    ) -> Result<(), ExperimentError> {
        let (action, losses) = (self.data.action, &self.trained.training.losses);
        let network = Description::new(architecture, task, action, losses, normalizers, &self.spec.window)
            .map_err(LearningError::from)?;
        checkpoint::save(&self.claimed.checkpoint(task), parameters, normalizers, &network)?;
        Ok(())
    }

    /// Judges a predictor on the test windows. Adds the results to the outcome.
    fn judge(
        &self,
        task: Task,
        predictor: &dyn Predictor,
        outcome: &mut Outcome,
    ) -> Result<(), ExperimentError> {
        let begin = Instant::now();
        let PreparedData { open: OpenData { partition, .. }, references, .. } = self.prepared;
        // The table of predictions does not tell an untrained encoder from the trained one.
        let sampled = (predictor.name() != models::UNTRAINED).then_some(&references.sampled[..]);
        let test = Test {
            samples: &self.data.samples,
            task,
            windows: &partition.test,
            since_s: &self.spec.window.since_s,
            sampled,
        };
        let judged = judge(predictor, &test)?;
        outcome.extend(judged);
        outcome.timings.evaluation += begin.elapsed().as_secs_f64();
        Ok(())
    }
}
