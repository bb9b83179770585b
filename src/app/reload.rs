//! SIGHUP: API keys and TLS files are read again, without a restart.

use anyhow::{Context, bail};

use super::settings::keys;
use super::start::App;
use crate::api::tls_acceptor;
use crate::config::Config;

impl App {
    /// Takes the API keys and the TLS files of a configuration that was read again. Requests and
    /// connections from now on need the new keys and get the new certificate; open ones go on. Other
    /// values of the configuration take effect at the next start.
    ///
    /// # Errors
    /// Nothing is changed if a key or a TLS file cannot be used, or if the configuration turns keys or
    /// TLS on or off, which needs a restart.
    pub fn reload(&self, config: &Config) -> anyhow::Result<()> {
        let keys = keys(config)?;
        if keys.is_open() != self.service.has_no_keys() {
            bail!("keys cannot be turned on or off without a restart");
        }
        match (&self.tls, &config.tls) {
            (None, None) => {}
            (Some(port), Some(tls)) => {
                let read = tls_acceptor(&tls.certificate, &tls.key).context("tls")?;
                port.set(read);
            }
            _ => bail!("TLS cannot be turned on or off without a restart"),
        }
        self.service.exchange_keys(keys);
        Ok(())
    }
}
