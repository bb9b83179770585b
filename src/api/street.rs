//! A simulated street, for callers who want to try the service without data of their own.
//!
//! Independent of HTTP and gRPC types.

use super::auth::Caller;
use super::error::ApiError;
use super::service::Service;
use crate::flow::simulate::{Street, StreetOptions};
use crate::formats::{CloudFormat, write_cloud};

/// Number of sweeps of the street.
pub(super) const SWEEPS: usize = 50;

impl Service {
    /// A sweep of a simulated street as a PCD file: about 120,000 points of a lidar with 64 beams.
    /// Consecutive sweeps are 0.1 s apart.
    ///
    /// # Errors
    /// - [`ApiError::BadRequest`] if the street has no sweep with this index.
    /// - [`ApiError::Forbidden`] for a caller with a share link.
    pub(super) async fn street_sweep(
        &self,
        caller: &Caller,
        seed: u64,
        index: usize,
    ) -> Result<Vec<u8>, ApiError> {
        caller.has_key()?;
        if index >= SWEEPS {
            let text = format!("the street has the sweeps 0 to {}", SWEEPS - 1);
            return Err(ApiError::BadRequest(text));
        }
        let options = StreetOptions {
            seed,
            sweeps: SWEEPS,
            ..StreetOptions::default()
        };
        let simulate = move || {
            let street = Street::new(&options).map_err(ApiError::internal)?;
            let sweep = street.sweep(index).map_err(ApiError::internal)?;
            let mut bytes = Vec::new();
            write_cloud(CloudFormat::Pcd, &sweep.points, &mut bytes).map_err(ApiError::internal)?;
            Ok(bytes)
        };
        self.compute(&caller.tenant, simulate).await
    }
}
