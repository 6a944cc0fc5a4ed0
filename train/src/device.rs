use barchan_model::Device;
use serde::{Deserialize, Serialize};

use crate::TrainError;

/// Where training runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceName {
    /// Burn's own CPU kernels: the default.
    Flex,
    /// The `ndarray` crate on the CPU: slower, a second opinion.
    Ndarray,
    /// libtorch on the CPU; in builds with the feature `tch`.
    Tch,
    /// A graphics card through Vulkan; in builds with the feature `vulkan`.
    Vulkan,
}

impl DeviceName {
    /// Every device there can be, compiled in or not.
    pub const ALL: [Self; 4] = [Self::Flex, Self::Ndarray, Self::Tch, Self::Vulkan];

    /// As `--device` and `config.toml` have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::Ndarray => "ndarray",
            Self::Tch => "tch",
            Self::Vulkan => "vulkan",
        }
    }

    /// The device, without gradients.
    ///
    /// # Errors
    /// When this build has it not, or the machine has it not; the message says how to get it.
    pub fn device(self) -> Result<Device, TrainError> {
        match self {
            Self::Flex => Ok(Device::flex()),
            // Deprecated in 0.22, whose version is pinned; wanted as a second opinion.
            #[allow(deprecated)]
            Self::Ndarray => Ok(Device::ndarray()),
            Self::Tch => libtorch(),
            Self::Vulkan => vulkan(),
        }
    }
}

#[cfg(feature = "tch")]
fn libtorch() -> Result<Device, TrainError> {
    // Deprecated in 0.22, whose version is pinned; the fastest 3-D convolutions on a CPU.
    #[allow(deprecated)]
    Ok(Device::libtorch())
}

#[cfg(not(feature = "tch"))]
fn libtorch() -> Result<Device, TrainError> {
    Err(TrainError::Config(
        "device tch: not in this build\n  cure: `make tch` fetches libtorch and builds with it (or: `make libtorch`, then `cargo build --release --features tch` with LIBTORCH set as that says); or --device flex".into(),
    ))
}

#[cfg(feature = "vulkan")]
fn vulkan() -> Result<Device, TrainError> {
    use burn::tensor::{DeviceKind, Tensor};
    // The library can only panic where there is no graphics card: it is asked for one number, with
    // nothing printed, before anything depends on it.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let answer = std::panic::catch_unwind(|| {
        let device = Device::vulkan(DeviceKind::DefaultDevice);
        let one = Tensor::<1>::ones([1], &device).into_scalar::<f32>();
        (one == 1.0).then_some(device)
    });
    std::panic::set_hook(hook);
    answer.ok().flatten().ok_or_else(|| {
        TrainError::Config(
            "device vulkan: no graphics card answers through Vulkan\n  cure: install its Vulkan driver (`vulkaninfo` lists what works); or --device flex".into(),
        )
    })
}

#[cfg(not(feature = "vulkan"))]
fn vulkan() -> Result<Device, TrainError> {
    Err(TrainError::Config(
        "device vulkan: not in this build\n  cure: `cargo build --release --features vulkan`; or --device flex".into(),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cpu_devices_are_always_there_and_others_say_how_to_get_them() {
        for name in DeviceName::ALL {
            match name.device() {
                Ok(_) => {}
                Err(error) => {
                    assert!(!matches!(name, DeviceName::Flex | DeviceName::Ndarray));
                    let message = error.to_string();
                    assert!(message.contains(name.name()) && message.contains("cure"));
                }
            }
        }
    }
}
