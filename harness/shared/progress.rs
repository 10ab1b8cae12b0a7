//! How long work tells its caller how far it is. The library reports; only the command line draws.

/// Receives the progress of one command. Calls may come from several threads.
pub trait Progress: Sync {
    /// A stage of `total` steps begins; `unit` names one step ("samples", "epochs").
    fn begin(&self, stage: &str, total: u64, unit: &str);
    /// `steps` more are done.
    fn advance(&self, steps: u64);
    /// `steps` of the stage were done before it began: by the process that it goes on from.
    fn resume(&self, steps: u64) {
        self.advance(steps);
    }
    /// A short note on the current stage, such as the latest losses; the next one replaces it.
    fn note(&self, text: &str);
    /// Something that a person should read even when the stage is long over.
    fn say(&self, text: &str);
    /// The stage is over.
    fn end(&self);
    /// Where one of several jobs that go on side by side reports to, under its name; `None`: here as well.
    fn job(&self, _name: &str) -> Option<Box<dyn Progress + '_>> {
        None
    }
    /// Whether the caller wants the work to stop at the next step.
    fn cancelled(&self) -> bool {
        false
    }
}

/// Reports to nobody.
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _stage: &str, _total: u64, _unit: &str) {}
    fn advance(&self, _steps: u64) {}
    fn note(&self, _text: &str) {}
    fn say(&self, _text: &str) {}
    fn end(&self) {}
}
