use super::codes::ordered;
use super::header::VoxelType;

/// Calls `take` with the number and the stored value of every voxel in `bytes`.
pub(crate) fn each_value(voxel: VoxelType, big_endian: bool, bytes: &[u8], take: impl FnMut(usize, f64)) {
    let big = big_endian;
    match voxel {
        VoxelType::U8 => each(bytes, |[b]: [u8; 1]| b.into(), take),
        VoxelType::I8 => each(bytes, |[b]: [u8; 1]| (b as i8).into(), take),
        VoxelType::U16 => each(bytes, |b| u16::from_le_bytes(ordered(b, big)).into(), take),
        VoxelType::I16 => each(bytes, |b| i16::from_le_bytes(ordered(b, big)).into(), take),
        VoxelType::U32 => each(bytes, |b| u32::from_le_bytes(ordered(b, big)).into(), take),
        VoxelType::I32 => each(bytes, |b| i32::from_le_bytes(ordered(b, big)).into(), take),
        VoxelType::U64 => each(bytes, |b| u64::from_le_bytes(ordered(b, big)) as f64, take),
        VoxelType::I64 => each(bytes, |b| i64::from_le_bytes(ordered(b, big)) as f64, take),
        VoxelType::F32 => each(bytes, |b| f32::from_le_bytes(ordered(b, big)).into(), take),
        VoxelType::F64 => each(bytes, |b| f64::from_le_bytes(ordered(b, big)), take),
    }
}

fn each<const N: usize>(bytes: &[u8], value: impl Fn([u8; N]) -> f64, mut take: impl FnMut(usize, f64)) {
    for (n, &b) in bytes.as_chunks::<N>().0.iter().enumerate() {
        take(n, value(b));
    }
}
