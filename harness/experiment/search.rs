//! Searches: the standing of their trials, the best one, and successive halving.

use super::Planned;
use harness_metrics::epoch::{Losses, TOTAL};
use harness_registry::{RunFolder, Status};
use harness_spec::{Experiment, RunSpec, Search, Task, Trained, Trial};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The trainings of which successive halving makes a run, from the shortest to the whole one; without halving one.
pub(super) type Rungs = Arc<Vec<(RunFolder, RunSpec)>>;

/// The best trial of a search so far. Each scenario, latent size and combination of varied settings has its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Best {
    /// The best trial's run with the first seed.
    pub run: RunSpec,
    /// The trial's settings, by dotted key.
    pub settings: Trial,
    /// Its value of the objective, a mean over seeds.
    pub loss: f64,
    /// Number of trials that are done or have diverged.
    pub judged: usize,
}

impl Best {
    /// Whether a run is one of the trial's runs, of which there is one for each seed.
    pub fn is_of(&self, spec: &RunSpec) -> bool {
        (&self.run.scenario, self.run.latent(), &self.run.variant)
            == (&spec.scenario, spec.latent(), &spec.variant)
    }
}

/// What is known about a run's trainings.
pub(super) struct Record {
    /// Index of the longest training that is done.
    pub reached: Option<usize>,
    /// Index of the shortest training that diverged.
    diverged: Option<usize>,
    /// The validation losses of each epoch of the longest training.
    losses: Vec<Losses>,
}

impl Record {
    /// Reads the records of a run's trainings. A training whose losses can't be read is treated as not done.
    pub fn read(rungs: &Rungs) -> Self {
        let mut diverged = None;
        for (index, (folder, _)) in rungs.iter().enumerate().rev() {
            match folder.record().ok().flatten() {
                Some(record) if record.status == Status::Done => {
                    match folder.validation_losses(&record, Task::Prediction) {
                        Ok(losses) => return Self { reached: Some(index), diverged, losses },
                        // Another process has trained the run further and removed this training since the longer ones
                        // were looked for.
                        Err(_) if !folder.path().exists() => return Self::read(rungs),
                        Err(_) => {}
                    }
                }
                Some(record) if record.diverged => diverged = Some(index),
                _ => {}
            }
        }
        Self { reached: None, diverged, losses: Vec::new() }
    }

    /// Whether the training up to a rung is done or has diverged.
    fn is_judged(&self, rung: usize) -> bool {
        self.reached.is_some_and(|reached| reached >= rung) || self.has_diverged(rung)
    }

    fn has_diverged(&self, rung: usize) -> bool {
        self.diverged.is_some_and(|diverged| diverged <= rung)
    }

    /// The objective after the training up to a rung: the validation loss of the network that such a training keeps. It
    /// is infinite if the training diverged.
    fn loss(&self, term: &str, rung: usize, spec: &RunSpec) -> f64 {
        if self.has_diverged(rung) {
            return f64::INFINITY;
        }
        let Some(Trained { training, .. }) = spec.trained() else { return f64::INFINITY };
        let epochs = training.final_epoch().min(self.losses.len());
        let of = |term: &str, losses: &Losses| losses.get(term).copied().unwrap_or(f64::INFINITY);
        let epochs = &self.losses[..epochs];
        let total = |a: &&Losses, b: &&Losses| of(TOTAL, a).total_cmp(&of(TOTAL, b));
        let kept = match training.patience {
            Some(_) => epochs.iter().min_by(total),
            None => epochs.last(),
        };
        kept.map_or(f64::INFINITY, |losses| of(term, losses))
    }
}

/// How far a run has to be trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Standing {
    /// Index of the training.
    pub rung: usize,
    /// Whether it is known that no longer training follows.
    pub is_last: bool,
}

/// The trials of one scenario, latent size and combination of varied settings: indices of their runs.
type Trials = BTreeMap<usize, Vec<usize>>;

/// A search and the records of its runs.
struct Standings<'a> {
    search: &'a Search,
    runs: &'a [Rungs],
    records: Vec<Record>,
}

impl<'a> Standings<'a> {
    fn new(search: &'a Search, runs: &'a [Rungs]) -> Self {
        Self { search, runs, records: runs.iter().map(Record::read).collect() }
    }

    /// The trials of each scenario, latent size and combination of varied settings, in the order of the runs.
    fn groups(&self) -> Vec<Trials> {
        let mut groups: Vec<(_, Trials)> = Vec::new();
        for (index, rungs) in self.runs.iter().enumerate() {
            let spec = &rungs[0].1;
            let key = (&spec.scenario, spec.latent(), spec.variant_parts().0);
            let Some(trial) = spec.trial() else { continue };
            let place = groups.iter().position(|(other, _)| *other == key).unwrap_or_else(|| {
                groups.push((key, Trials::new()));
                groups.len() - 1
            });
            groups[place].1.entry(trial).or_default().push(index);
        }
        groups.into_iter().map(|(_, trials)| trials).collect()
    }

    /// The trials with their losses after a rung, the best first. Equal losses are in the order of the trials' numbers.
    fn ranking(&self, trials: &Trials, rung: usize) -> Vec<(usize, f64)> {
        let loss = |run: &usize| {
            self.records[*run].loss(&self.search.objective.term, rung, &self.runs[*run][rung].1)
        };
        let mean = |runs: &Vec<usize>| runs.iter().map(loss).sum::<f64>() / runs.len() as f64;
        let mut ranking: Vec<(usize, f64)> =
            trials.iter().map(|(trial, runs)| (*trial, mean(runs))).collect();
        ranking.sort_by(|(_, a), (_, b)| a.total_cmp(b));
        ranking
    }

    /// The trials that get as far as each rung, as far as it is decided. Only the last of these rungs may be
    /// incomplete.
    fn rungs(&self, trials: &Trials) -> Vec<Trials> {
        let Some(first) = trials.values().flatten().next() else { return Vec::new() };
        let last = self.runs[*first].len() - 1;
        let mut rungs = vec![trials.clone()];
        for rung in 0..last {
            let members = &rungs[rung];
            if members.values().flatten().any(|run| !self.records[*run].is_judged(rung)) {
                break;
            }
            let kept =
                self.search.halving.as_ref().map_or(members.len(), |halving| halving.kept(members.len()));
            let ranking = self.ranking(members, rung);
            let kept = ranking.iter().take(kept).filter(|(_, loss)| loss.is_finite());
            let next: Trials = kept.map(|(trial, _)| (*trial, members[trial].clone())).collect();
            if next.is_empty() {
                break;
            }
            rungs.push(next);
        }
        rungs
    }

    /// How far each run has to be trained.
    fn standings(&self) -> Vec<Standing> {
        let mut standings: Vec<Standing> = self
            .records
            .iter()
            .map(|record| Standing { rung: record.reached.unwrap_or_default(), is_last: true })
            .collect();
        for trials in self.groups() {
            let rungs = self.rungs(&trials);
            let present = rungs.len() - 1;
            for (rung, members) in rungs.iter().enumerate() {
                for run in members.values().flatten() {
                    // An earlier search with fewer trials may have trained the run further.
                    let rung_of_run = rung.max(self.records[*run].reached.unwrap_or_default());
                    let is_complete =
                        members.values().flatten().all(|run| self.records[*run].is_judged(rung));
                    standings[*run] = Standing { rung: rung_of_run, is_last: rung < present || is_complete };
                }
            }
        }
        standings
    }

    /// The best trial of each group, if any trial has got to the end.
    fn best(&self) -> Vec<Best> {
        let drawn = self.search.draw();
        let of_group = |trials: Trials| {
            let rungs = self.rungs(&trials);
            let members = rungs.last()?;
            let last = self.runs[*members.values().flatten().next()?].len() - 1;
            let is_judged = |runs: &Vec<usize>| runs.iter().all(|run| self.records[*run].is_judged(last));
            let judged: Trials =
                members.iter().filter(|(_, runs)| is_judged(runs)).map(|(t, r)| (*t, r.clone())).collect();
            let (trial, loss) =
                self.ranking(&judged, last).into_iter().next().filter(|(_, loss)| loss.is_finite())?;
            let run = self.runs[judged[&trial][0]][last].1.clone();
            let judged = if last == 0 { judged.len() } else { trials.len() };
            Some(Best { run, settings: drawn[trial].clone(), loss, judged })
        };
        self.groups().into_iter().filter_map(of_group).collect()
    }
}

/// How far each run of an experiment has to be trained. Without successive halving, each run is one training.
pub(super) fn standings(experiment: &Experiment, runs: &[Rungs]) -> Vec<Standing> {
    match &experiment.search {
        Some(search) if search.halving.is_some() => Standings::new(search, runs).standings(),
        _ => vec![Standing { rung: 0, is_last: true }; runs.len()],
    }
}

/// The best trial for each scenario, latent size and combination of varied settings of a search, by the runs that are
/// done. With successive halving, one is best if it has been trained to the end.
pub fn best(experiment: &Experiment, plan: &[Planned]) -> Vec<Best> {
    let Some(search) = &experiment.search else { return Vec::new() };
    let runs: Vec<Rungs> = plan.iter().map(|planned| planned.rungs.clone()).collect();
    Standings::new(search, &runs).best()
}
