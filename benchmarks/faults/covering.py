"""Further tests of a module: other files that run its lines, found by coverage of the fast tests, file by file.

First those that run lines which the tests named beside its faults do not run, then some that run many of them, quick
ones and those of the package before others. Modules that no fault is written for have all their tests here.
"""

from collections import defaultdict

#: Module and files, ``cli/complete`` for ``tests/cli/test_complete.py``; a module may have several rows.
_TABLE = """
alignment.align alignment/map_family cli/align_command runtime/numerics
alignment.error_model alignment/map_family cli/align_command runtime/numerics
alignment.map_family alignment/align cli/align_command
alignment.options alignment/map_family alignment/align
alignment.references alignment/map_family cli/align_command runtime/numerics
alignment.residual_noise alignment/map_family cli/align_command runtime/numerics
calibration calibration/score_calibration integrations/lerobot_package experiments/uncertainty_study
calibration extract/policy_columns docs/docs
calibration.monotone calibration/score_calibration experiments/compare_methods
calibration.score_calibration extract/policy_columns integrations/lerobot_package experiments/uncertainty_study
calibration.score_calibration docs/docs test_sigma_budget
cli.align cli/align_command
cli.capture_checks cli/capture_checks cli/captures_without_depth cli/enrich extract/policy_columns
cli.commands cli/fetch runtime/allocator cli/commands cli/exit cli/output cli/captures_without_depth cli/resume
cli.complete cli/complete cli/process_capture robustness/written_values
cli.completed_folder cli/process_capture cli/align_command cli/complete
cli.enrich cli/captures_without_depth cli/enrich extract/enrich_guarantees test_clients extract/policy_columns
cli.enrich robustness/written_values
cli.enrich_card cli/captures_without_depth extract/policy_columns test_clients cli/enrich
cli.enrich_page cli/enrich extract/enrich_guarantees
cli.errors cli/captures_without_depth cli/fetch cli/exit cli/resume cli/pin_command
cli.fetch cli/fetch
cli.inspect data/stored_readings viz/drawn_figures cli/inspect cli/option_checks data/rlds data/lerobot
cli.job cli/resume cli/output cli/inspect
cli.layouts cli/complete cli/align_command cli/process_capture
cli.option_checks cli/exit cli/option_checks test_settings cli/resume cli/captures_without_depth cli/align_command
cli.option_checks cli/process_capture
cli.pin cli/pin_command
cli.pin_words cli/pin_command measure/pin
cli.process_capture cli/process_capture cli/capture_checks cli/captures_without_depth
cli.recover_page cli/capture_checks cli/process_capture
cli.recover_pictures cli/process_capture
cli.run cli/captures_without_depth cli/output cli/commands cli/option_checks cli/run cli/resume cli/align_command
cli.run cli/process_capture cli/validate_command
cli.scale cli/scale_command
cli.signals cli/fetch cli/exit cli/pin_command cli/resume cli/captures_without_depth cli/align_command
cli.stream cli/captures_without_depth
cli.sweep_state cli/output cli/option_checks
cli.validate cli/validate_command
cli.view viz/viewer
codes transforms/shown cli/pin_command measure/pin cli/process_capture
data data/readers data/azure_kinect data/record3d data/simulator_hdf5 data/ca1m
data.clocks data/stray data/image_folders data/rosbag robustness/damaged_files
data.codecs.bag_messages robustness/damaged_files
data.codecs.colmap data/models data/image_folders cli/scale_command robustness/damaged_files
data.codecs.exr data/plausibility data/image_folders data/orientation integrate/level
data.codecs.hdf5 experiments/focal_stacks robustness/damaged_files
data.codecs.lzfse data/image_folders cli/inspect
data.codecs.matroska robustness/damaged_files
data.codecs.mp4 data/record3d data/plausibility data/rh20t data/image_folders
data.codecs.npy data/readers data/plausibility data/models data/real_pieces data/decompression_bombs
data.codecs.parquet data/image_folders pipeline/rig data/real_pieces extract/shards
data.codecs.pfm data/plausibility data/real_pieces
data.codecs.pgm data/plausibility data/real_pieces
data.codecs.pickles data/rh20t data/decompression_bombs robustness/damaged_files
data.codecs.ros_images robustness/damaged_files
data.codecs.ros_messages robustness/damaged_files
data.codecs.rosbag1 robustness/damaged_files
data.codecs.rosbag_database robustness/damaged_files
data.codecs.tarballs data/image_folders data/decompression_bombs cli/inspect
data.codecs.tfrecord data/image_folders test_clients robustness/written_values
data.codecs.thrift extract/shards data/image_folders data/lerobot data/real_pieces pipeline/rig
data.codecs.tiff data/image_folders data/lerobot extract/written_rows test_clients
data.codecs.video data/azure_kinect data/plausibility data/rh20t data/lerobot data/image_folders
data.codecs.zips data/depth_maps data/readers data/record3d data/plausibility
data.convert data/arkitscenes data/rlds data/pose_convention data/image_folders data/plausibility data/real_pieces
data.convert data/rosbag
data.corrections data/posed_images data/rlds data/image_folders data/lerobot
data.depth_maps cli/validate_command cli/align_command robustness/damaged_files
data.foreign_files data/foreign_files data/azure_kinect data/record3d data/readers cli/captures_without_depth
data.foreign_files cli/inspect
data.intrinsics data/tum data/rlds data/lerobot data/azure_kinect data/readers
data.io.decode data/decompression_bombs data/posed_images data/orientation cli/pin_command data/plausibility
data.io.decode data/image_folders data/tum
data.io.decode data/decompression_bombs data/corrections
data.laser data/ca1m data/arkitscenes robustness/damaged_files
data.members data/image_folders cli/inspect
data.models data/models cli/scale_command
data.models.colmap cli/scale_command
data.models.nerfstudio data/models
data.models.scene_model measure/scale cli/scale_command
data.orientation data/corrections data/posed_images data/stray extract/policy_columns cli/process_capture
data.pairs cli/run pipeline/view_report
data.pickled_arrays data/rh20t data/decompression_bombs robustness/damaged_files
data.plausibility data/depth_maps cli/validate_command cli/captures_without_depth cli/process_capture
data.pose_convention data/corrections validation/pose_check validation/capture_check
data.readers.arkitscenes data/image_folders cli/inspect
data.readers.azure_kinect robustness/damaged_files
data.readers.bop robustness/damaged_files
data.readers.ca1m data/image_folders robustness/damaged_files
data.readers.colmap data/image_folders robustness/damaged_files
data.readers.driving data/plausibility data/real_pieces metrics/holdout cli/inspect
data.readers.frames_dir data/plausibility data/real_pieces data/orientation data/corrections
data.readers.image_table data/plausibility data/real_pieces data/orientation robustness/damaged_files
data.readers.lerobot cli/enrich data/image_folders data/real_pieces pipeline/rig extract/policy_columns
data.readers.lerobot_depth data/image_folders pipeline/rig cli/enrich
data.readers.lerobot_meta data/image_folders data/real_pieces pipeline/rig extract/policy_columns
data.readers.lerobot_rows data/image_folders data/real_pieces pipeline/rig extract/policy_columns
data.readers.lerobot_video data/lerobot data/image_folders data/real_pieces extract/policy_columns cli/inspect
data.readers.nerfstudio data/image_folders robustness/damaged_files
data.readers.open3d robustness/damaged_files
data.readers.polycam data/image_folders
data.readers.posed_images cli/enrich data/image_folders robustness/damaged_files
data.readers.record3d data/plausibility data/image_folders data/orientation integrate/level
data.readers.record3d_live data/record3d
data.readers.record3d_video data/image_folders cli/inspect
data.readers.rectified data/plausibility data/real_pieces pipeline/pair robustness/damaged_files
data.readers.rh20t cli/inspect
data.readers.rh20t_set data/rh20t
data.readers.rlds data/image_folders test_clients robustness/damaged_files
data.readers.rlds_steps robustness/written_values
data.readers.rosbag robustness/damaged_files
data.readers.rosbag_cameras robustness/damaged_files
data.readers.rosbag_index robustness/damaged_files
data.readers.rosbag_transforms robustness/damaged_files
data.readers.scannet robustness/damaged_files
data.readers.simulator_hdf5 robustness/written_values
data.readers.stray data/plausibility data/image_folders cli/complete cli/process_capture
data.readers.tum data/readers data/image_folders data/corrections data/plausibility data/real_pieces data/orientation
data.recording data/ca1m cli/scale_command data/simulator_hdf5 data/arkitscenes data/rlds data/image_folders
data.rig pipeline/rig extract/enrich_guarantees
data.scene data/pairs data/readers extract/policy_columns cli/resume cli/captures_without_depth
data.stored_sizes data/posed_images data/tum data/corrections data/stray
data.survey data/rlds data/lerobot cli/option_checks
data.units data/depth_maps data/corrections cli/validate_command data/image_folders
data.unread data/tum data/image_folders data/posed_images data/arkitscenes data/readers data/plausibility
experiments.compare_methods experiments/dense_comparison experiments/method_comparison experiments/xfeat
experiments.probes.ridge test_contract
export.arrays export/export integrate/colmap_model extract/written_rows test_clients cli/complete
export.arrays robustness/written_values
export.colmap integrate/colmap_model robustness/written_values
export.frames cli/complete cli/align_command cli/process_capture robustness/written_values
export.glb export/export cli/process_capture cli/complete robustness/written_values
export.lerobot test_clients extract/policy_columns cli/captures_without_depth robustness/damaged_files
export.lerobot extract/written_rows robustness/written_values
export.nerfstudio extract/written_rows test_clients robustness/written_values
export.ply export/export extract/written_rows cli/process_capture test_clients robustness/written_values
export.tiff export/writers data/ca1m extract/written_rows test_clients data/image_folders robustness/written_values
export.video extract/policy_columns cli/process_capture robustness/resumed_outputs robustness/written_values
extract extract/extract transforms/dense_loader
extract.columns extract/policy_columns extract/written_rows extract/extract_stub extract/extract
extract.columns robustness/written_values
extract.cut cli/captures_without_depth robustness/resumed_outputs robustness/written_values
extract.dataset transforms/dense_loader extract/enrich_guarantees extract/written_rows extract/policy_columns
extract.dataset extract/extract_stub pipeline/method robustness/written_values
extract.engines extract/policy_columns extract/extract test_clients robustness/written_values
extract.enriched extract/policy_columns test_clients cli/captures_without_depth robustness/damaged_files
extract.enriched robustness/written_values
extract.features extract/extract extract/extract_stub transforms/dense_loader robustness/written_values
extract.instants extract/policy_columns test_clients cli/captures_without_depth robustness/damaged_files
extract.instants robustness/written_values
extract.nerf_target test_clients robustness/written_values
extract.origin extract/policy_columns robustness/written_values
extract.pixel_columns extract/policy_columns robustness/written_values
extract.plan extract/enrich_guarantees extract/written_rows extract/policy_columns extract/extract_stub test_clients
extract.plan robustness/written_values
extract.policy_columns extract/written_rows test_clients robustness/resumed_outputs cli/captures_without_depth
extract.policy_columns robustness/written_values
extract.robot_target extract/policy_columns robustness/resumed_outputs test_clients cli/captures_without_depth
extract.robot_target robustness/written_values
extract.shards extract/extract_stub extract/written_rows extract/policy_columns transforms/dense_loader
extract.shards robustness/written_values
extract.step_set robustness/written_values
extract.targets extract/policy_columns test_clients cli/captures_without_depth robustness/damaged_files
extract.targets robustness/written_values
functional.policy_inputs extract/policy_columns
geometry.affine_alignment ops/compiled geometry/sensor_noise geometry/reference_implementations geometry/kornia
geometry.affine_alignment geometry/coarse_flow
geometry.camera geometry/kornia ops/compiled geometry/plane_sweep pipeline/merge transforms/kornia_samples
geometry.camera integrate/colmap_model
geometry.checks pipeline/accelerator geometry/sensor_noise geometry/kornia losses/weighted geometry/affine_alignment
geometry.coarse_flow pipeline/guided pipeline/inputs extract/policy_columns pipeline/few_returns
geometry.components metrics/map_quality pipeline/map_filters transforms/same_inputs pipeline/surface
geometry.covariance geometry/motion_fit cli/pin_command geometry/sensor_noise geometry/map_estimate geometry/kornia
geometry.covariance pipeline/pair
geometry.determinism geometry/sensor_noise geometry/affine_alignment geometry/reference_implementations
geometry.determinism geometry/kornia
geometry.epipolar ops/compiled geometry/sensor_noise geometry/kornia transforms/shown stages/triangulate
geometry.epipolar_motion cli/pin_command measure/pin
geometry.filters geometry/plane_sweep synthetic/depth_faults data/posed_images extract/policy_columns
geometry.free_space pipeline/inputs pipeline/guided pipeline/few_returns pipeline/fused
geometry.inference_mode geometry/sensor_noise geometry/affine_alignment geometry/reference_implementations
geometry.inference_mode geometry/kornia
geometry.least_squares ops/compiled geometry/sensor_noise geometry/map_estimate geometry/kornia
geometry.least_squares geometry/reprojection_problem
geometry.linalg geometry/sensor_noise geometry/kornia geometry/affine_alignment pipeline/inputs
geometry.lucas_kanade ops/compiled geometry/sensor_noise geometry/reference_implementations geometry/affine_alignment
geometry.lucas_kanade geometry/kornia
geometry.map_estimate geometry/sensor_noise geometry/kornia pipeline/inputs pipeline/guided
geometry.motion_fit cli/pin_command
geometry.no_depth data/depth_maps extract/plan data/corrections transforms/extend_depth_stub
geometry.p3p geometry/ransac geometry/sensor_noise geometry/map_estimate geometry/kornia
geometry.patches ops/compiled geometry/sensor_noise geometry/kornia geometry/reference_implementations
geometry.patches stages/front_end
geometry.plane_sweep ops/compiled pipeline/surface pipeline/fused extract/policy_columns transforms/same_inputs
geometry.pose_conventions transforms/sample_spec pipeline/rig pipeline/guided transforms/kornia_samples
geometry.pyramid geometry/sensor_noise geometry/affine_alignment geometry/reference_implementations
geometry.pyramid geometry/affine_alignment_reference
geometry.ransac geometry/sensor_noise geometry/map_estimate geometry/kornia transforms/shown
geometry.reprojection_problem ops/compiled geometry/sensor_noise geometry/map_estimate geometry/kornia pipeline/inputs
geometry.se3 viz/plots cli/process_capture geometry/motion_fit geometry/map_estimate pipeline/guided pipeline/rig
geometry.sensor_noise cli/complete measure/scale cli/scale_command
geometry.sparse_grid integrate/integrate integrate/volume cli/process_capture
geometry.windows transforms/same_inputs pipeline/surface extract/policy_columns pipeline/fused
integrate.colmap_model robustness/written_values
integrate.from_maps cli/process_capture
integrate.level integrate/integrate cli/process_capture
integrate.mapping cli/process_capture
integrate.picture integrate/picture
integrate.recording pipeline/view_report
integrate.scales cli/process_capture
integrate.surface integrate/mapping cli/process_capture
integrate.sweeps viz/viewer
integrate.volume cli/process_capture
measure.change_points measure/pin cli/pin_command
measure.local_scales cli/scale_command
measure.pin cli/pin_command
measure.scale cli/scale_command
metrics.bootstrap experiments/defocus_fusion experiments/method_comparison experiments/uncertainty_study
metrics.bootstrap learning/learned_confidence
metrics.camera_paths measure/scale cli/scale_command
metrics.change_points cli/pin_command
metrics.control experiments/compare_methods calibration/score_calibration
metrics.correlation metrics/risk experiments/protocols learning/learned_confidence experiments/defocus_fusion
metrics.curves experiments/uncertainty_study experiments/xfeat learning/learned_confidence
metrics.curves experiments/method_comparison
metrics.detection validation/wrong_causes
metrics.errors metrics/risk experiments/uncertainty_study learning/learned_confidence experiments/xfeat
metrics.grouped measure/scale cli/scale_command
metrics.holdout experiments/protocols experiments/uncertainty_study experiments/xfeat learning/learned_confidence
metrics.map_quality pipeline/map_filters
metrics.reliability metrics/errors experiments/compare_methods experiments/xfeat experiments/method_comparison
metrics.reliability experiments/uncertainty_study
metrics.risk metrics/uncertainty experiments/xfeat experiments/method_comparison experiments/compare_methods
metrics.uncertainty experiments/uncertainty_study experiments/method_comparison experiments/compare_methods
metrics.uncertainty experiments/xfeat
pipeline.completion extract/policy_columns test_sigma_budget cli/process_capture transforms/same_inputs
pipeline.dense ops/compiled pipeline/fused transforms/same_inputs extract/policy_columns test_sigma_budget
pipeline.fused test_sigma_budget runtime/numerics viz/viewer
pipeline.inputs pipeline/inputs pipeline/guided pipeline/merge pipeline/multiview pipeline/fused
pipeline.map_filters pipeline/surface pipeline/fused pipeline/dense transforms/same_inputs
pipeline.method transforms/shown stages/pose_prior pipeline/fused pipeline/merge pipeline/inputs pipeline/rig
pipeline.multiview cli/captures_without_depth pipeline/inputs pipeline/view_report pipeline/few_returns
pipeline.multiview pipeline/stream pipeline/method
pipeline.pair ops/compiled pipeline/inputs pipeline/rig pipeline/view_report pipeline/degenerate
pipeline.picture_matching cli/scale_command
pipeline.planes pipeline/surface pipeline/fused pipeline/dense test_sigma_budget
pipeline.presets pipeline/rig test_clients transforms/extend_depth_stub extract/policy_columns
pipeline.rig docs/docs
pipeline.spec pipeline/rig integrations/lerobot_package transforms/wrappers transforms/extend_depth_stub
pipeline.stream cli/captures_without_depth
pipeline.surface ops/compiled pipeline/fused transforms/same_inputs extract/policy_columns test_sigma_budget
pipeline.view_report viz/viewer cli/process_capture
pipeline.view_selection pipeline/view_report cli/captures_without_depth cli/process_capture pipeline/multiview
pytree stages/inverse_variance pipeline/inputs pipeline/rig pipeline/guided
records pipeline/merge pipeline/fused cli/pin_command cli/complete test_sigma_budget pipeline/guided
records extract/policy_columns geometry/sensor_noise
runtime.allocator extract/shards test_clients extract/policy_columns cli/pin_command
runtime.code_dependencies runtime/results test_clients extract/policy_columns cli/resume
runtime.console cli/fetch runtime/allocator cli/exit cli/commands cli/output test_clients extract/policy_columns
runtime.console data/lerobot cli/resume
runtime.file_lock runtime/output_folder cli/exit cli/fetch test_clients data/rlds
runtime.numerics runtime/numerics transforms/shown integrations/lerobot_package data/tum functional/policy_inputs
runtime.output_folder cli/fetch test_clients cli/align_command extract/policy_columns
runtime.ply data/models viz/plots viz/viewer cli/process_capture
runtime.results cli/resume cli/exit cli/run extract/policy_columns
runtime.safe_open data/tum data/rh20t data/ca1m data/readers data/simulator_hdf5
runtime.storage data/models cli/exit extract/policy_columns extract/written_rows test_clients extract/shards
stages.backproject ops/compiled stages/inverse_variance stages/guided_search stages/contradicted stages/misalignment
stages.features geometry/kornia
stages.fuse stages/misalignment pipeline/inputs pipeline/view_report pipeline/few_returns
stages.guided_search pipeline/guided
stages.holes ops/compiled stages/inverse_variance stages/guided_search stages/contradicted stages/misalignment
stages.kornia.backproject test_sigma_budget
stages.kornia.holes test_sigma_budget
stages.kornia.pose test_sigma_budget
stages.kornia.track stages/track_chain test_sigma_budget
stages.kornia.triangulate test_sigma_budget
stages.misalignment ops/compiled stages/contradicted stages/features stages/fuse geometry/sensor_noise
stages.pose ops/compiled stages/pose_prior stages/contradicted stages/misalignment stages/features stages/fuse
stages.pose_prior pipeline/rig pipeline/guided
stages.sample stages/inverse_variance stages/guided_search stages/contradicted stages/misalignment
stages.score test_gradients stages/pose_prior pipeline/view_report pipeline/pair
stages.shared_error pipeline/inputs pipeline/guided pipeline/few_returns pipeline/fused
stages.track stages/track_chain stages/inverse_variance stages/contradicted stages/misalignment pipeline/guided
stages.triangulate stages/misalignment stages/inverse_variance stages/features stages/fuse
transforms.adapters transforms/shown transforms/adapters transforms/dense_loader transforms/extend_depth test_clients
transforms.collate transforms/adapters transforms/wrappers transforms/flagged_epoch transforms/extend_depth
transforms.extend_depth transforms/flagged_epoch transforms/extend_depth transforms/adapters transforms/shown
transforms.extend_depth transforms/same_inputs transforms/dense_loader
transforms.kornia geometry/kornia
transforms.layout transforms/extend_depth_stub transforms/adapters transforms/dense_loader
transforms.maps integrations/lerobot_package extract/policy_columns stages/pose_prior
transforms.poses transforms/poses pipeline/rig transforms/sample_spec transforms/kornia_samples
transforms.sample_access transforms/adapters transforms/wrappers transforms/kornia_samples transforms/shown
transforms.sample_access transforms/flagged_epoch
transforms.sample_spec transforms/extend_depth_stub transforms/adapters transforms/wrappers transforms/shown
transforms.schema transforms/wrappers transforms/adapters transforms/shown transforms/flagged_epoch
transforms.status transforms/wrappers transforms/adapters transforms/shown transforms/flagged_epoch
transforms.tokens ops/compiled transforms/extend_depth_stub transforms/shown transforms/wrappers
transforms.tokens transforms/same_inputs
validation.capture_check data/rlds extract/policy_columns cli/process_capture cli/inspect
validation.edge_fault validation/capture_check cli/process_capture
validation.edge_lag validation/capture_check cli/process_capture
validation.evidence validation/wrong_causes runtime/numerics cli/validate_command
validation.faults validation/capture_check extract/policy_columns
validation.options validation/wrong_causes validation/validate
validation.picture_field cli/scale_command cli/complete cli/process_capture
validation.pose_check validation/capture_check extract/policy_columns
validation.validate runtime/numerics cli/validate_command
validation.wrong_causes validation/validate runtime/numerics
viz.plots.axis viz/drawn_figures experiments/sweep_tables viz/viewer cli/pin_command cli/align_command
viz.plots.canvas viz/drawn_figures viz/plots viz/viewer data/rlds cli/process_capture cli/align_command
viz.plots.canvas cli/validate_command cli/pin_command
viz.plots.colours viz/drawn_figures viz/viewer_cameras viz/plots viz/viewer cli/process_capture cli/validate_command
viz.plots.document cli/pin_command cli/align_command cli/validate_command cli/scale_command viz/viewer_cameras
viz.plots.maps viz/drawn_figures viz/viewer cli/align_command cli/process_capture cli/complete cli/validate_command
viz.plots.markup experiments/sweep_tables viz/viewer cli/pin_command cli/align_command
viz.plots.panel viz/drawn_figures viz/plots experiments/sweep_tables cli/pin_command cli/scale_command
viz.plots.pictures viz/drawn_figures docs/report docs/report_page viz/viewer
viz.plots.previews viz/drawn_figures cli/process_capture
viz.plots.svg viz/drawn_figures viz/plots cli/pin_command robustness/resumed_outputs
viz.plots.validation viz/drawn_figures viz/plots cli/validate_command
viz.viewer.again viz/viewer
viz.viewer.exhibit viz/viewer_cameras viz/viewer cli/process_capture
viz.viewer.html viz/viewer cli/process_capture robustness/written_values
viz.viewer.pin cli/pin_command
viz.viewer.points viz/viewer cli/process_capture
viz.viewer.validation cli/validate_command cli/align_command cli/scale_command
"""

TESTS: dict[str, list[str]] = defaultdict(list)
for _module, *_files in (row.split() for row in _TABLE.strip().splitlines()):
    TESTS[_module] += [f"tests/{name.replace('/', '/test_')}.py" for name in _files]
