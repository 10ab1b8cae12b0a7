//! `harness serve`.

use super::{DONE, interrupt};
use anyhow::Result;
use clap::Args;
use harness::registry::Registry;
use harness::{claims, serve};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Serve {
    /// The port on 127.0.0.1, or 0 for any free port
    #[arg(long, value_name = "PORT", default_value_t = 8787)]
    port: u16,
    /// The file of claims. `claims` stands for claims.yaml, experiments/claims.yaml or the built-in claims, whichever
    /// exists first
    #[arg(long, value_name = "FILE", default_value = "claims")]
    claims: PathBuf,
}

impl Serve {
    /// Serves the page until a signal ends it.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let claims = claims::load(&self.claims)?;
        registry.check_there()?;
        interrupt::install()?;
        // A panic in Polars is the answer to a query, so nothing must be printed about it.
        std::panic::set_hook(Box::new(|_| {}));
        let ready = |address| println!("http://{address}  (Ctrl-C ends it)");
        serve::serve(registry.clone(), claims, self.port, ready, interrupt::requested)?;
        Ok(ExitCode::from(DONE))
    }
}
