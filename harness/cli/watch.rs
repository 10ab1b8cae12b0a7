//! `harness watch`: everything that is running, refreshed each second.

use super::DONE;
use super::inspect::check_started;
use super::table::{Grid, fitted, size, width};
use super::{output, submit};
use anyhow::Result;
use clap::Args;
use harness::files::FolderLock;
use harness::learning::training::{Epoch, TOTAL};
use harness::numbers::duration;
use harness::registry::{Recorded, Registry, Remembered, RunRecord, Status, live_epochs};
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// Time between two pictures.
const INTERVAL: Duration = Duration::from_secs(1);
/// Time between two questions to Slurm about waiting tasks.
const SLURM_INTERVAL: Duration = Duration::from_secs(10);
/// Number of epochs from which the time of an epoch is computed.
const RECENT: usize = 10;

#[derive(Args)]
pub struct Watch {
    /// Show only the runs of these experiments [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// Print once, and end
    #[arg(long)]
    once: bool,
}

impl Watch {
    /// Prints what is running until nothing is.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let mut waiting: Option<(Instant, Vec<[String; 6]>)> = None;
        let (mut memory, mut drawn) = (Remembered::default(), 0);
        loop {
            if waiting.as_ref().is_none_or(|(asked, _)| asked.elapsed() >= SLURM_INTERVAL) {
                // Without Slurm there are no tasks. Tasks that have ended are not shown.
                let tasks = submit::tasks(registry).unwrap_or_default();
                waiting =
                    Some((Instant::now(), tasks.into_iter().filter(|task| task[2] == "pending").collect()));
            }
            let waiting = waiting.as_ref().map_or(&[][..], |(_, tasks)| tasks.as_slice());
            registry.refresh(&mut memory);
            let view = View::of(registry, memory.recorded(), &self.experiments, waiting)?;
            let text = view.text(width());
            if let Some((_, height)) = size() {
                // The cursor goes back to the beginning of the last picture, which is then erased.
                let back = if drawn > 0 { format!("\x1b[{drawn}A\x1b[J") } else { String::new() };
                let shown: Vec<&str> = text.lines().take(usize::from(height).saturating_sub(1)).collect();
                println!("{back}{}", shown.join("\n"));
                drawn = shown.len();
            } else {
                println!("{text}");
            }
            if self.once || view.is_idle() || output::is_closed() {
                return Ok(ExitCode::from(DONE));
            }
            std::thread::sleep(INTERVAL);
        }
    }
}

/// The runs, collections and tasks at one moment.
struct View {
    /// The number of chosen runs with each status, in words.
    counts: String,
    runs: Vec<[String; 7]>,
    /// Datasets that are being collected: name, process, episodes.
    datasets: Vec<[String; 3]>,
    /// Tasks of submitted jobs that wait for the cluster.
    waiting: Vec<[String; 6]>,
}

impl View {
    fn of(
        registry: &Registry,
        all: &[Recorded],
        experiments: &[String],
        waiting: &[[String; 6]],
    ) -> Result<Self> {
        let is_chosen =
            |record: &RunRecord| experiments.is_empty() || experiments.contains(&record.experiment);
        check_started(all.iter().map(|(_, record)| record), registry, experiments)?;
        let chosen: Vec<_> = all.iter().filter(|(_, record)| is_chosen(record)).collect();
        let counted = [Status::Running, Status::Done, Status::Failed, Status::Interrupted].map(|status| {
            let count = chosen.iter().filter(|(_, record)| record.status == status).count();
            (count > 0).then(|| format!("{count} {}", status.name()))
        });
        let counts: Vec<String> = counted.into_iter().flatten().collect();
        let running = chosen.iter().filter(|(_, record)| record.status == Status::Running);
        Ok(Self {
            counts: if counts.is_empty() { "no runs".into() } else { counts.join(", ") },
            runs: running.map(|(folder, record)| row(folder, record)).collect(),
            datasets: datasets(registry),
            waiting: waiting.to_vec(),
        })
    }

    fn is_idle(&self) -> bool {
        self.runs.is_empty() && self.datasets.is_empty() && self.waiting.is_empty()
    }

    fn text(&self, limit: Option<u16>) -> String {
        let mut parts =
            vec![format!("{} ({} UTC)", self.counts, jiff::Timestamp::now().strftime("%H:%M:%S"))];
        if !self.runs.is_empty() {
            let header = ["run", "process", "epoch", "loss", "training", "each", "left"];
            let mut table = Grid::of_texts(header, self.runs.clone());
            table.right = vec![false, false, true, true, true, true, true];
            parts.push(table.text(limit));
            let meaning = "loss: validation, weighted sum of all terms; each: time of an epoch; left: at most, in this \
                           task";
            parts.push(fitted(meaning, limit));
        }
        if !self.datasets.is_empty() {
            let header = ["dataset", "process", "episodes"];
            parts.push(Grid::of_texts(header, self.datasets.clone()).text(limit));
        }
        if !self.waiting.is_empty() {
            let header = ["job", "step", "state", "host", "time", "why it waits"];
            parts.push(Grid::of_texts(header, self.waiting.clone()).text(limit));
        }
        parts.join("\n\n")
    }
}

/// The row of a running run.
fn row(folder: &Path, record: &RunRecord) -> [String; 7] {
    let epochs = live_epochs(folder);
    let task = epochs.last().map(|(task, _)| *task);
    let own: Vec<&Epoch> =
        epochs.iter().filter(|(of, _)| Some(*of) == task).map(|(_, epoch)| epoch).collect();
    let loss = |of: fn(&Epoch) -> &harness::learning::training::Losses| {
        let value = own.last().and_then(|epoch| of(epoch).get(TOTAL));
        value.map_or("-".into(), |value| format!("{value:.4}"))
    };
    let planned = record.spec.trained().map_or(0, |trained| trained.training.final_epoch());
    let recent = &own[own.len().saturating_sub(RECENT)..];
    let each = recent.iter().map(|epoch| epoch.seconds).sum::<f64>() / recent.len() as f64;
    let time = |seconds: f64| if own.is_empty() { "-".into() } else { duration(seconds) };
    [
        record.run.clone(),
        FolderLock::holder(folder).map_or("-".into(), |holder| process(&holder)),
        task.map_or("none yet".into(), |_| format!("{}/{planned}", own.len())),
        loss(|epoch| &epoch.validation),
        loss(|epoch| &epoch.train),
        time(each),
        time(each * planned.saturating_sub(own.len()) as f64),
    ]
}

/// The datasets that a process collects.
fn datasets(registry: &Registry) -> Vec<[String; 3]> {
    let folders = std::fs::read_dir(registry.datasets()).into_iter().flatten().flatten();
    let mut rows: Vec<[String; 3]> = folders
        .filter_map(|folder| {
            let holder = FolderLock::in_use(&folder.path())?;
            let files = std::fs::read_dir(folder.path()).ok()?.flatten();
            let episodes =
                files.filter(|file| file.file_name().to_string_lossy().starts_with("episode_")).count();
            Some([folder.file_name().to_string_lossy().into_owned(), process(&holder), episodes.to_string()])
        })
        .collect();
    rows.sort();
    rows
}

/// The holder of a lock, such as `process 4711 on host`, as `host 4711`.
fn process(holder: &str) -> String {
    let words: Vec<&str> = holder.split(' ').collect();
    match words[..] {
        ["process", number, "on", host] => format!("{host} {number}"),
        _ => holder.to_owned(),
    }
}
