use crate::gpu::kernels::{ENTRIES, SHADERS, shader};
use crate::gpu::layout::{
    Body, Cluster, Constants, Entry, Exchange, Particle, Plane, Report, Solid, Substep, Tied,
};
use std::mem::offset_of;

#[test]
fn shaders_stay_inside_the_default_limits() {
    for (name, _) in SHADERS {
        let shader = shader(name).unwrap_or_else(|e| panic!("{e}"));
        for point in shader.entry_points() {
            let [x, y, z] = point.workgroup_size;
            assert!(
                point.storage_buffers <= 8,
                "{}: {} storage buffers",
                point.name,
                point.storage_buffers
            );
            assert!(
                x * y * z <= 256,
                "{}: workgroup {:?}",
                point.name,
                point.workgroup_size
            );
            assert!(
                point.workgroup_bytes <= 16_384,
                "{}: {} B",
                point.name,
                point.workgroup_bytes
            );
            let entry = ENTRIES.iter().find(|e| e.name == point.name && e.shader == *name);
            let entry = entry.unwrap_or_else(|| panic!("{name}: no entry for {}", point.name));
            let storage = entry.slots.iter().filter(|s| (**s as u32) > 1).count();
            assert_eq!(
                storage as u32, point.storage_buffers,
                "{}: bound and used",
                point.name
            );
        }
    }
}

/// Compares a struct with its twin in a shader, member by member.
macro_rules! same_layout {
    ($shader:literal, $name:ident { $($member:ident),+ $(,)? }) => {
        let shader = shader($shader).expect("shader");
        let layout = shader.struct_layout(stringify!($name)).expect(stringify!($name));
        assert_eq!(layout.size as usize, size_of::<$name>(), stringify!($name));
        let here = [$((stringify!($member), offset_of!($name, $member))),+];
        for (name, offset) in here {
            let there = layout.members.iter().find(|m| m.name == name).map(|m| m.offset as usize);
            assert_eq!(there, Some(offset), "{}.{}", stringify!($name), name);
        }
        let named = layout.members.iter().filter(|m| !m.name.starts_with("unused")).count();
        assert_eq!(named, here.len(), "members of {}", stringify!($name));
    };
}

#[test]
fn structs_lie_alike_on_both_sides() {
    same_layout!(
        "integrate",
        Constants {
            gravity,
            h,
            down,
            drag_factor,
            particles,
            clusters,
            bodies,
            solids,
            omega,
            mass_scaling,
            sleep,
            max_speed,
            max_change,
            restitution,
            friction,
            static_friction,
            cell,
            inverse_cell,
            hash_mask,
            contact_width,
            rest_filter,
            passes,
            total,
            beta,
            substeps,
            chunks,
            force_scale,
            keep,
            symmetric,
            stabilise_self,
        }
    );
    same_layout!(
        "tally",
        Substep {
            index,
            first_solid,
            last
        }
    );
    same_layout!(
        "tally",
        Particle {
            rest,
            inverse_mass,
            body,
            area_mm2,
            first_entry,
            entries
        }
    );
    same_layout!(
        "clusters",
        Body {
            half_contact,
            half_margin,
            distance,
            margin,
            mass,
            free,
            first_cluster,
            clusters,
            drift,
        }
    );
    same_layout!(
        "solids",
        Solid {
            from_rotation,
            from_translation,
            kind,
            to_rotation,
            to_translation,
            data,
            lo,
            friction,
            hi,
            static_friction,
            size,
            distance,
        }
    );
    same_layout!(
        "solids",
        Plane {
            normal,
            offset,
            drift,
            solid,
            push,
            normal_push,
            twist,
            pressed
        }
    );
    same_layout!(
        "tally",
        Exchange {
            push,
            normal,
            twist,
            area_mm2,
            contacts,
            depth_mm
        }
    );
    same_layout!(
        "tally",
        Report {
            force,
            normal_force,
            torque,
            area_mm2,
            smooth_force,
            depth_mm,
            contacts,
        }
    );
    same_layout!(
        "clusters",
        Cluster {
            share,
            inverse_moment,
            first,
            count
        }
    );
    same_layout!("gather", Entry { local, cluster });
    same_layout!(
        "skin",
        Tied {
            rest,
            clusters,
            weights,
            local
        }
    );
}
