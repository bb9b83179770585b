//! Classification of operating system errors: a missing file, a full disk, or another fault of the
//! machine.
//!
//! A missing file counts as a failed attempt of its job. The other faults do not: the job waits and
//! is tried again.

use std::error::Error;
use std::io;

/// The cause of an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// A file does not exist.
    Missing,
    /// No more data can be written: no space, inodes or quota, or a file size limit.
    Full,
    /// All other errors: descriptors, permissions, device failures, memory.
    Machine,
}

impl Fault {
    /// Classifies an error of the operating system.
    pub fn of_io(error: &io::Error) -> Self {
        use io::ErrorKind::{FileTooLarge, NotFound, QuotaExceeded, StorageFull};
        match error.kind() {
            NotFound => Self::Missing,
            StorageFull | QuotaExceeded | FileTooLarge => Self::Full,
            _ => Self::Machine,
        }
    }

    /// Classifies an error by the first operating system error in its chain of causes. Without one
    /// it is [`Fault::Machine`].
    pub fn of(error: &(dyn Error + 'static)) -> Self {
        Self::io_error(error).map_or(Self::Machine, Self::of_io)
    }

    /// The first operating system error in the chain of causes of an error.
    pub fn io_error<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a io::Error> {
        let mut cause = Some(error);
        while let Some(error) = cause {
            if let Some(error) = error.downcast_ref::<io::Error>() {
                return Some(error);
            }
            cause = error.source();
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("a store failed")]
    struct Wrapped(#[source] io::Error);

    #[test]
    fn errors_of_the_system_are_the_machines_unless_something_is_missing() {
        const ENOENT: i32 = 2;
        const EIO: i32 = 5;
        const EACCES: i32 = 13;
        const EMFILE: i32 = 24;
        const EFBIG: i32 = 27;
        const ENOSPC: i32 = 28;
        const EROFS: i32 = 30;
        const EDQUOT: i32 = 122;
        for (code, fault) in [
            (ENOENT, Fault::Missing),
            (EIO, Fault::Machine),
            (EACCES, Fault::Machine),
            (EMFILE, Fault::Machine),
            (EFBIG, Fault::Full),
            (ENOSPC, Fault::Full),
            (EROFS, Fault::Machine),
            (EDQUOT, Fault::Full),
        ] {
            let error = io::Error::from_raw_os_error(code);
            assert_eq!(Fault::of_io(&error), fault, "{error}");
            let wrapped = Wrapped(error);
            assert_eq!(Fault::of(&wrapped), fault, "{wrapped}");
        }
        assert_eq!(Fault::of(&std::fmt::Error), Fault::Machine);
    }
}
