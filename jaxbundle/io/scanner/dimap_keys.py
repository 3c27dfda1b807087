"""Keys of the XML of DIMAP: those used, and those that may be left, by element.

Source: the dictionaries of DIMAP 1 (SPOT), DIMAP 2 and 3 (Pléiades, SPOT 6 and 7, Pléiades Neo).
"""

from jaxbundle.io.text.known_keys import Keys

FOOTPRINT = "of the footprint of the product, or of its delivery; the model has what it needs"
RADIOMETRY = "grey values, no geometry"
HISTORY = "how the product was made"
COUNTED = "the length of a list that follows"
STATE = "of the equipment: the values are the corrected ones"
BASE = {
    "METADATA_*": HISTORY,
    "version": "of a dictionary",
    "name": FOOTPRINT,
}
# Positions, line periods and the times of polynomials state their units.
WITH_UNIT = Keys(("unit",))

DIMAP2_DOCUMENT = Keys(
    (
        *("Metadata_Identification", "Dataset_Identification", "Raster_Data", "Geometric_Data"),
        # What is used of these decides whether the image has the geometry of the camera.
        *("Geoposition", "Processing_Information"),
        # Of the first products of Pléiades.
        *("Raster_Dimensions", "Product_Characteristics"),
    ),
    {
        **BASE,
        **dict.fromkeys(
            (
                *("Dataset_Content", "Coordinate_Reference_System", "Product_Frame"),
                *("Product_Information", "Dataset_Sources", "Archive", "Catalog", "Programming"),
            ),
            FOOTPRINT,
        ),
        **dict.fromkeys(("Radiometric_Data", "Image_Interpretation"), RADIOMETRY),
        **dict.fromkeys(("Quality_Assessment", "Processing", "Production", "Telemetry"), HISTORY),
        "Data_Strip": STATE,
    },
)
DIMAP2: dict[str, Keys] = {
    "Metadata_Identification": Keys(("METADATA_PROFILE",), BASE),
    "Dataset_Identification": Keys(
        ("DATASET_NAME",),
        {
            "DATASET_*": FOOTPRINT,
            "COPYRIGHT": FOOTPRINT,
            "Legal_Constraints": FOOTPRINT,
            "Security_Constraints": FOOTPRINT,
        },
    ),
    "Geoposition": Keys(
        ("Raster_CRS",),
        {
            "Geoposition_Models": "RPC, which are in a file of their own",
            "Rational_Sensor_Model": "RPC, with which the model is compared",
            "Geoposition_*": FOOTPRINT,
        },
    ),
    "Raster_CRS": Keys(
        ("RASTER_GEOMETRY",),
        {
            "PIXEL_*": "of the RPC; the model counts from the centre of the first pixel",
            "RASTER_CRS_*": "of the RPC",
        },
    ),
    "Processing_Information": Keys(
        ("Product_Settings",), {"Production_Facility": HISTORY, "Processing_Lineage": HISTORY}
    ),
    "Product_Settings": Keys(
        ("PROCESSING_LEVEL",),
        {
            "SPECTRAL_PROCESSING": RADIOMETRY,
            "Radiometric_Settings": RADIOMETRY,
            "MTF_Settings": RADIOMETRY,
            "Geometric_Settings": STATE,
            "Sampling_Settings": "of the RPC and maps; a sensor image has the pixels of the model",
        },
    ),
    "Product_Characteristics": Keys(
        ("PROCESSING_LEVEL",), {"Product_*": RADIOMETRY, "SPECTRAL_PROCESSING": RADIOMETRY}
    ),
    "Raster_Data": Keys(
        ("Raster_Dimensions",),
        dict.fromkeys(("Data_Access", "Raster_Encoding", "Raster_Display"), RADIOMETRY),
    ),
    "Raster_Dimensions": Keys(
        ("NROWS", "NCOLS"),
        {
            **dict.fromkeys(("NBANDS", "NBITS", "COMPRESSION"), RADIOMETRY),
            **dict.fromkeys(("Tile_Set", "Raster_Tiles"), "files that together are the image"),
        },
    ),
    "Geometric_Data": Keys(
        ("Refined_Model", "Sensor_Model_Characteristics"),
        {"Use_Area": "angles and sizes on the ground, which follow from the model"},
    ),
    "Refined_Model": Keys(
        ("Time", "Ephemeris", "Attitudes", "Geometric_Calibration"),
        {
            "MODEL_USED": STATE,
            "Coordinate_Reference_System": "always the geocentric one of WGS 84, and UTC",
            "Instrument_Configuration": "nominal; the angles of the pixels are calibrated",
        },
    ),
    "Time": Keys(("Time_Range", "Time_Stamp")),
    "Time_Range": Keys(("START", "END")),
    "Time_Stamp": Keys(("LINE_PERIOD",)),
    "LINE_PERIOD": WITH_UNIT,
    "Ephemeris": Keys(("Point_List",), {"EPHEMERIS_USED": STATE}),
    "Point_List": Keys(("Point",)),
    "Point": Keys(
        ("LOCATION_XYZ", "TIME", "LOCATION_VALUES", "UTC_TIME"),
        dict.fromkeys(
            ("VELOCITY_XYZ", "VELOCITY_VALUES"), "follows from the positions, which are dense"
        ),
    ),
    "LOCATION_XYZ": WITH_UNIT,
    "LOCATION_VALUES": WITH_UNIT,
    "Attitudes": Keys(("Polynomial_Quaternions", "Quaternion_List"), {"ATTITUDES_USED": STATE}),
    "Polynomial_Quaternions": Keys(("OFFSET", "SCALE", "Q0", "Q1", "Q2", "Q3")),
    "OFFSET": WITH_UNIT,
    "SCALE": WITH_UNIT,
    **{f"Q{k}": Keys(("COEFFICIENTS",), {"DEGREE": COUNTED}) for k in range(4)},
    "Quaternion_List": Keys(("Quaternion",)),
    "Quaternion": Keys(("TIME", "Q0", "Q1", "Q2", "Q3"), {"Q_STATUS": STATE}),
    "Geometric_Calibration": Keys(("Instrument_Calibration",)),
    "Instrument_Calibration": Keys(
        ("Swath_Range", "Polynomial_Look_Angles", "Band_Calibration_List", "Instrument_Biases"),
    ),
    "Instrument_Biases": Keys(("YAW", "PITCH", "ROLL")),
    "Band_Calibration_List": Keys(("Band_Calibration",)),
    "Band_Calibration": Keys(
        ("BAND_ID", "Polynomial_Look_Angles", "Swath_Range", "Instrument_Biases")
    ),
    "Swath_Range": Keys(("FIRST_COL",), {"LAST_COL": "follows from the number of columns"}),
    "Polynomial_Look_Angles": Keys([f"{axis}LOS_{k}" for axis in "XY" for k in range(4)]),
    # The first products of Pléiades.
    "Sensor_Model_Characteristics": Keys(
        (
            *("UTC_Sensor_Model_Range", "Sensor_Ephemeris", "Sensor_Attitudes"),
            *("SENSOR_LINE_PERIOD", "Sensor_Viewing_Model"),
        )
    ),
    "SENSOR_LINE_PERIOD": WITH_UNIT,
    "UTC_Sensor_Model_Range": Keys(("START", "END")),
    "Sensor_Ephemeris": Keys(("Point_List",)),
    "Sensor_Attitudes": Keys(("Polynomial_Models", "OFFSET", "SCALE")),
    "Polynomial_Models": Keys(("Q0", "Q1", "Q2", "Q3")),
    "Sensor_Viewing_Model": Keys(("Position_In_Retina", "Viewing_Directions")),
    "Position_In_Retina": Keys(("FIRST_COL",), {"LAST_COL": "follows from the columns"}),
    "Viewing_Directions": Keys(("PsiX_Model", "PsiY_Model")),
    "PsiX_Model": Keys(("COEFFICIENTS",), {"DEGREE": COUNTED}),
    "PsiY_Model": Keys(("COEFFICIENTS",), {"DEGREE": COUNTED}),
}

DIMAP1_DOCUMENT = Keys(
    ("Dataset_Id", "Raster_Dimensions", "Data_Processing", "Data_Strip"),
    {
        **BASE,
        **dict.fromkeys(
            (
                *("Metadata_Id", "Dataset_Frame", "Coordinate_Reference_System", "Raster_CS"),
                *("Geoposition", "Dataset_Sources", "Data_Access"),
            ),
            FOOTPRINT,
        ),
        **dict.fromkeys(("Image_Display", "Raster_Encoding", "Image_Interpretation"), RADIOMETRY),
        "Production": HISTORY,
        "Quality_Assessment": HISTORY,
    },
)
VECTOR = Keys(("X", "Y", "Z"), {"unit": "always metres"})
DIMAP1: dict[str, Keys] = {
    "Dataset_Id": Keys(("DATASET_NAME",), {"DATASET_*": FOOTPRINT, "COPYRIGHT": FOOTPRINT}),
    "Raster_Dimensions": Keys(("NROWS", "NCOLS"), {"NBANDS": RADIOMETRY}),
    "Data_Processing": Keys(
        ("PROCESSING_LEVEL",),
        {
            "GEOMETRIC_PROCESSING": "the same in words",
            "RADIOMETRIC_PROCESSING": RADIOMETRY,
            "MEAN_RECTIFICATION_ELEVATION": "of rectified levels, which are refused",
            "SPECTRAL_PROCESSING": RADIOMETRY,
            "Processing_Options": RADIOMETRY,
        },
    ),
    "Data_Strip": Keys(
        ("Ephemeris", "Satellite_Attitudes", "Sensor_Configuration"),
        {
            "Data_Strip_Identification": HISTORY,
            "Satellite_Time": "the clock, already in the times",
            "Frame_Counters": HISTORY,
            "Data_Strip_Coordinates": "of the scene within the strip; times are those of the scene",
            "Models": "of the one-dimensional correction, not of level 1A",
            "Sensor_Calibration": RADIOMETRY,
        },
    ),
    "Ephemeris": Keys(
        ("Points",),
        {
            **dict.fromkeys(("SATELLITE_ALTITUDE", "NADIR_LAT", "NADIR_LON"), FOOTPRINT),
            **dict.fromkeys(
                ("DORIS_USED", "Doris_Points", "Orbital_Bulletin"), "from which the points are made"
            ),
        },
    ),
    "Points": Keys(("Point",)),
    "Point": Keys(("Location", "Velocity", "TIME")),
    "Location": VECTOR,
    "Velocity": VECTOR,
    "Satellite_Attitudes": Keys(
        ("Corrected_Attitudes",), {"Raw_Attitudes": "from which the corrected ones are made"}
    ),
    "Corrected_Attitudes": Keys(("Corrected_Attitude",), {"STAR_TRACKER_USED": STATE}),
    "Corrected_Attitude": Keys(("Angles",)),
    "Angles": Keys(("TIME", "YAW", "PITCH", "ROLL"), {"OUT_OF_RANGE": STATE}),
    "Sensor_Configuration": Keys(
        (
            *("Time_Stamp", "Instrument_Look_Angles_List"),
            *("DEREGISTRATION_VALUE", "COUPLED_DEREGISTRATION_VALUE"),
        )
    ),
    "Time_Stamp": Keys(
        ("LINE_PERIOD", "SCENE_CENTER_TIME", "SCENE_CENTER_LINE"), {"SCENE_CENTER_COL": FOOTPRINT}
    ),
    "LINE_PERIOD": WITH_UNIT,
    "Instrument_Look_Angles_List": Keys(("Instrument_Look_Angles",)),
    "Instrument_Look_Angles": Keys(
        ("Look_Angles_List", "BAND_INDEX"), {"VALIDITY_DATE": "of the calibration"}
    ),
    "Look_Angles_List": Keys(("Look_Angles",)),
    "Look_Angles": Keys(("PSI_X", "PSI_Y"), {"DETECTOR_ID": "the number of the pixel"}),
}
