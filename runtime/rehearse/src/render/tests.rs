use super::*;
use glam::Vec3;

fn camera(width: usize, height: usize) -> Camera {
    Camera {
        right: Vec3::X,
        up: Vec3::Y,
        toward: Vec3::Z,
        centre: Vec3::ZERO,
        px_per_mm: 4.0,
        width,
        height,
    }
}

fn item(mesh: &Mesh, material: Material) -> Item<'_> {
    Item {
        vertices: &mesh.vertices,
        normals: &mesh.normals,
        triangles: &mesh.triangles,
        material,
    }
}

fn drawn(view: &View3d, camera: &Camera) -> Picture {
    let mut out = Picture::new(camera.width, camera.height, [0.0; 3]);
    draw_view(view, camera, &mut out, 0);
    out
}

const WHITE: Material = Material {
    lit: false,
    ..Material::plain([1.0; 3])
};

#[test]
fn a_sphere_covers_the_area_of_its_disc_wherever_it_stands() {
    for centre in [
        Vec3::ZERO,
        Vec3::new(0.13, -3.27, 8.0),
        Vec3::new(2.5, 1.125, -40.0),
    ] {
        let mesh = ball(centre, 9.0, 96);
        let view = View3d {
            opaque: vec![item(&mesh, WHITE)],
            ..View3d::default()
        };
        let image = drawn(&view, &camera(160, 120));
        let ink: f64 = image.pixels.iter().map(|&p| f64::from(p)).sum::<f64>() / (3.0 * 255.0);
        let disc = std::f64::consts::PI * (9.0f64 * 4.0).powi(2);
        assert!((ink / disc - 1.0).abs() < 2e-3, "{centre}: {ink} {disc}");
    }
}

#[test]
fn triangles_that_share_edges_leave_no_gap_and_no_overlap() {
    // A fan of slivers over a square: every pixel inside must be full, on two nested layers alike.
    let mut mesh = Mesh::default();
    let ring: Vec<Vec3> = (0..97)
        .map(|i| {
            let t = std::f32::consts::TAU * i as f32 / 97.0;
            Vec3::new(11.0 * t.cos(), 11.0 * t.sin(), 0.0)
        })
        .collect();
    mesh.vertices.push([0.31, 0.17, 0.0]);
    mesh.vertices.extend(ring.iter().map(|p| p.to_array()));
    mesh.normals = vec![[0.0, 0.0, 1.0]; mesh.vertices.len()];
    mesh.triangles = (0..97).map(|i| [0, 1 + i, 1 + (i + 1) % 97]).collect();
    let view = View3d {
        opaque: vec![item(&mesh, WHITE)],
        ..View3d::default()
    };
    let image = drawn(&view, &camera(120, 120));
    for y in 25..95 {
        for x in 25..95 {
            let r = f64::hypot(x as f64 - 59.5, y as f64 - 59.5);
            if r < 34.0 {
                assert_eq!(image.get(x, y), [255; 3], "({x}, {y})");
            }
        }
    }
    // What faces away is not drawn, unless both sides show.
    mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    let back = |two_sided| {
        let view = View3d {
            opaque: vec![item(&mesh, Material { two_sided, ..WHITE })],
            ..View3d::default()
        };
        drawn(&view, &camera(120, 120)).get(60, 60)
    };
    assert_eq!((back(false), back(true)), ([0; 3], [255; 3]));
}

/// A ball of 9 mm cut 4 mm before its middle: a flat disc of radius √65 mm, the slope around it, and nothing of what lies before the plane.
#[test]
fn a_cut_opens_closed_surfaces_and_takes_away_what_lies_before_it() {
    let (red, green) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);
    let cut = |colour| Material {
        cut: Some(1.0),
        shine: 0.0,
        ..Material::plain(colour)
    };
    let whole = ball(Vec3::new(0.0, 0.0, -4.0), 9.0, 96);
    let before = ball(Vec3::new(0.0, 0.0, 8.0), 3.0, 24);
    let inside = ball(Vec3::new(0.0, 0.0, 1.0), 2.0, 96);
    let view = View3d {
        veils: vec![
            item(&whole, cut(red)),
            item(&before, cut(green)),
            item(
                &inside,
                Material {
                    lift_mm: 0.5,
                    ..cut(green)
                },
            ),
        ],
        cut_mm: Some(0.0),
        ..View3d::default()
    };
    let image = drawn(&view, &camera(160, 120));
    let count = |wanted: [u8; 3]| image.pixels.chunks(3).filter(|p| *p == wanted).count() as f64;
    let disc = |squared: f64| std::f64::consts::PI * squared * 16.0;
    // A smaller ball's face, √3 mm, over the larger one's.
    let faces = [count([255, 0, 0]), count([0, 255, 0])];
    assert!((faces[1] / disc(3.0) - 1.0).abs() < 0.15, "{faces:?}");
    assert!((faces[0] / disc(65.0 - 3.0) - 1.0).abs() < 0.03, "{faces:?}");
    // Between the face and the outline the ball's own surface, shaded.
    let slope = image.get(80 + 34, 60);
    assert!(slope[0] > 20 && slope[0] < 255 && slope[1] == 0, "{slope:?}");
    let off = View3d { cut_mm: None, ..view };
    assert_eq!(
        drawn(&off, &camera(160, 120)).get(80, 60)[0],
        0,
        "uncut the green ball is in front"
    );
}

/// A lesion in a gland, cut through the middle, wherever both stand in the list: its face has another colour than the gland's and the organ's.
#[test]
fn a_structure_in_another_shows_in_the_cut() {
    let (gland, lesion) = (ball(Vec3::ZERO, 12.0, 48), ball(Vec3::ZERO, 4.0, 48));
    let elsewhere: Vec<Mesh> = (0..12)
        .map(|k| ball(Vec3::new(40.0 + k as f32, 0.0, 0.0), 1.0, 8))
        .collect();
    let organ = ball(Vec3::ZERO, 20.0, 48);
    for (a, b) in (0..12)
        .flat_map(|a| (0..12).map(move |b| (a, b)))
        .filter(|(a, b)| a != b)
    {
        let mut structures: Vec<&Mesh> = elsewhere.iter().collect();
        (structures[a], structures[b]) = (&gland, &lesion);
        let scene = SceneGeometry {
            organs: vec![&organ],
            structures,
            needles: vec![ball(Vec3::new(-30.0, 0.0, 0.0), 1.0, 8)],
            cut_mm: Some(0.0),
            ..SceneGeometry::default()
        };
        let picture = draw_frame(
            &scene,
            &camera(200, 160),
            0.6,
            None,
            &FrameText::default(),
            200,
            160,
        );
        let [lesion, gland, organ] = [100, 132, 164].map(|x| picture.get(x, 80).map(i32::from));
        let apart = |a: [i32; 3], b: [i32; 3]| (0..3).map(|k| (a[k] - b[k]).pow(2)).sum::<i32>();
        for (one, other) in [(lesion, gland), (gland, organ), (lesion, organ)] {
            assert!(apart(one, other) > 30 * 30, "{a} {b}: {one:?} {other:?}");
        }
    }
}

#[test]
fn nearer_wins_in_any_order_and_veils_let_through() {
    let red = Material {
        lit: false,
        ..Material::plain([1.0, 0.0, 0.0])
    };
    let blue = Material {
        colour: [0.0, 0.0, 1.0],
        ..red
    };
    let (near, far) = (ball(Vec3::Z * 12.0, 5.0, 24), ball(Vec3::ZERO, 5.0, 24));
    let centre = |view: &View3d| drawn(view, &camera(80, 80)).get(40, 40);
    for order in [[(&near, red), (&far, blue)], [(&far, blue), (&near, red)]] {
        let view = View3d {
            opaque: order.iter().map(|&(m, c)| item(m, c)).collect(),
            ..View3d::default()
        };
        assert_eq!(centre(&view), [255, 0, 0]);
    }
    let half = Material { opacity: 0.5, ..red };
    let over = |veil, body| View3d {
        opaque: vec![item(body, blue)],
        veils: vec![item(veil, half)],
        ..View3d::default()
    };
    assert_eq!(centre(&over(&near, &far)), [128, 0, 128]);
    assert_eq!(
        centre(&over(&far, &near)),
        [0, 0, 255],
        "a veil behind something does not show"
    );
    // Of two veils in the same place the lifted one is in front, whichever comes first.
    let lifted = Material { lift_mm: 0.5, ..half };
    let under = Material {
        colour: blue.colour,
        ..half
    };
    for veils in [[lifted, under], [under, lifted]] {
        let view = View3d {
            veils: veils.iter().map(|&m| item(&near, m)).collect(),
            ..View3d::default()
        };
        assert_eq!(centre(&view), [128, 0, 64]);
    }
}

#[test]
fn light_comes_from_the_upper_left() {
    let mesh = ball(Vec3::ZERO, 9.0, 64);
    let view = View3d {
        opaque: vec![item(&mesh, Material::plain([0.6; 3]))],
        ..View3d::default()
    };
    let image = drawn(&view, &camera(100, 100));
    let at = |dx: f32, dy: f32| image.get((50.0 + dx * 36.0) as usize, (50.0 + dy * 36.0) as usize)[0];
    let (lit, dark) = (at(-0.45, -0.45), at(0.55, 0.55));
    assert!(lit > dark + 40, "{lit} {dark}");
    // Smooth: no step between neighbours inside of the disc, for all that 64 rings have facets.
    for x in 30..70 {
        let step = i16::from(image.get(x, 60)[0]) - i16::from(image.get(x + 1, 60)[0]);
        assert!(step.abs() <= 8, "{x}: {step}");
    }
}

#[test]
fn a_polytope_of_six_planes_is_the_box() {
    let mut planes = vec![
        [1.0, 0.0, 0.0, 2.0],
        [-1.0, 0.0, 0.0, 2.0],
        [0.0, 2.0, 0.0, 6.0],
        [0.0, -1.0, 0.0, 3.0],
        [0.0, 0.0, 1.0, 1.0],
        [0.0, 0.0, -1.0, 4.0],
    ];
    let volume = |m: &Mesh| -> f32 {
        m.triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|v| Vec3::from(m.vertices[v as usize]));
                a.dot(b.cross(c)) / 6.0
            })
            .sum()
    };
    let plain = polytope(&planes);
    assert!(
        (volume(&plain) - 4.0 * 6.0 * 5.0).abs() < 1e-2,
        "{}",
        volume(&plain)
    );
    assert_eq!(plain.triangles.len(), 12);
    // A plane given twice and one that cuts nothing change nothing.
    planes.push([1.0, 0.0, 0.0, 2.0]);
    planes.push([1.0, 1.0, 1.0, 99.0]);
    assert!((volume(&polytope(&planes)) - 120.0).abs() < 1e-2);
}

#[test]
fn the_same_bytes_on_any_number_of_threads() {
    let (a, b) = (
        ball(Vec3::ZERO, 9.0, 32),
        capsule(Vec3::new(3.0, 2.0, 4.0), Vec3::Y, 5.0, 3.0, 16),
    );
    let scene = SceneGeometry {
        organs: vec![&a],
        structures: vec![&b],
        fiducials: &[[0.0; 3], [1.0, 2.0, 3.0]],
        plane: Some([Vec3::ZERO, Vec3::X, Vec3::ONE, Vec3::Y]),
        ..SceneGeometry::default()
    };
    let text = FrameText {
        title: "Probe press é".into(),
        lines: vec!["1.25 N".into()],
        caution: "not calibrated".into(),
        image: "level 0".into(),
    };
    let grey: Vec<u8> = (0..64 * 64).map(|i| (i * 7) as u8).collect();
    let picture = |threads: usize| {
        let image = GreyImage {
            width: 64,
            height: 64,
            grey: &grey,
            width_mm: 40.0,
            depth_mm: 60.0,
        };
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| draw_frame(&scene, &camera(300, 240), 0.6, Some(image), &text, 480, 240))
    };
    let one = picture(1);
    assert_eq!(one, picture(3));
    let png = encode_png("f", &one, &[("Comment", "forces are not calibrated")]).unwrap();
    let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
    assert_eq!(
        reader.info().utf8_text[0].get_text().unwrap(),
        "forces are not calibrated"
    );
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    assert_eq!(pixels, one.pixels);
}

#[test]
fn a_preview_plays_back_what_was_pushed() {
    let mut preview = Preview::default();
    let frames: Vec<Picture> = (0..4usize)
        .map(|n| {
            let mut p = Picture::new(40, 30, [0.2; 3]);
            // The last two are alike.
            p.rectangle(5 + 3 * n.min(2), 4 + n.min(2), 6, 5, [0.9, 0.1, 0.4]);
            p
        })
        .collect();
    frames.iter().for_each(|f| preview.push(f.clone()));
    preview.push(Picture::new(3, 3, [0.0; 3]));
    assert_eq!(preview.len(), 4);
    let bytes = preview.encode(0.1, &[]).unwrap();
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes))
        .read_info()
        .unwrap();
    let mut shown = Picture::new(40, 30, [0.0; 3]);
    for frame in &frames {
        let mut part = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut part).unwrap();
        let control = reader.info().frame_control.unwrap();
        let (x, y, w, h) = (control.x_offset, control.y_offset, control.width, control.height);
        for row in 0..h as usize {
            let from = 3 * row * w as usize;
            let to = 3 * ((y as usize + row) * 40 + x as usize);
            shown.pixels[to..to + 3 * w as usize].copy_from_slice(&part[from..from + 3 * w as usize]);
        }
        assert_eq!(&shown, frame);
    }
}
