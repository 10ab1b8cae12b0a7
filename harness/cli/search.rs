//! What `harness run` prints about a search.

use super::table::{print_command, print_text};
use harness::experiment::Best;
use harness::numbers::{counted, rounded};
use harness::registry::{Registry, quoted};
use harness::spec::{Experiment, RunSpec};

/// The settings of a trial for the plan: `learning_rate=0.00127 hidden=64: `; empty if the run is no trial.
pub fn described(spec: &RunSpec) -> String {
    match spec.variant_parts() {
        (_, Some(_), settings) => format!("{}: ", settings.replace(',', " ")),
        _ => String::new(),
    }
}

/// Prints how many trials are trained up to which epoch.
pub fn print_rungs(experiment: &Experiment) {
    let Some(search) = &experiment.search else { return };
    let Some(halving) = &search.halving else { return };
    let mut trials = search.trials;
    let rungs = halving.rungs(experiment.training.epochs).into_iter().map(|epochs| {
        let rung = format!("{trials} to epoch {epochs}");
        trials = halving.kept(trials);
        rung
    });
    let rungs = rungs.collect::<Vec<_>>().join(", the best ");
    print_text(&format!("\nsuccessive halving trains trials: {rungs}"));
}

/// Lines about the best trial of each scenario, latent size and combination of varied settings: its loss and its
/// settings.
pub fn best_trials(experiment: &Experiment, best: &[Best]) -> Vec<(String, String)> {
    let Some(search) = &experiment.search else { return Vec::new() };
    let term = &search.objective.term;
    let lines = best.iter().flat_map(|best| {
        let loss = rounded(best.loss);
        let (cell, trials) = (best.run.cell(), counted(best.judged, "trial"));
        let trial = format!("{cell} (lowest validation loss of {term}, {loss}, of {trials})");
        let settings = best.run.variant_parts().2.replace(',', " ");
        [("best run".to_owned(), trial), (String::new(), settings)]
    });
    lines.collect()
}

/// Prints a command for each best trial, which trains a network with its settings without a search. `words` are the
/// arguments of `harness run`.
pub fn print_commands(registry: &Registry, experiment: &Experiment, best: &[Best], words: &[String]) {
    for best in best {
        let own = best.settings.iter().map(|(key, value)| format!("{key}={value}"));
        let cell = cell(experiment, &best.run);
        let words = words.iter().cloned().chain(["search=null".to_owned()]).chain(cell).chain(own);
        let words: Vec<String> = words.collect();
        let command = quoted(["run"].into_iter().chain(words.iter().map(String::as_str)));
        print_command("retrain    ", &registry.command(&command));
    }
}

/// The overrides that limit the experiment to a run's scenario, latent size and varied settings.
fn cell(experiment: &Experiment, run: &RunSpec) -> Vec<String> {
    let mut overrides = Vec::new();
    if experiment.scenarios.len() > 1
        && let Some(origin) = experiment.scenarios.iter().find(|origin| origin.name() == run.scenario.name())
    {
        overrides.push(format!("scenarios=[{}]", String::from(origin.clone())));
    }
    if experiment.latent.len() > 1
        && let Some(latent) = run.latent()
    {
        overrides.push(format!("latent=[{latent}]"));
    }
    overrides.extend(experiment.varied(run).into_iter().map(|(key, value)| format!("{key}={value}")));
    overrides
}
