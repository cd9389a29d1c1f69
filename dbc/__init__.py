"""What is shipped: databases of inputs (``j1939.dbc``, ``obd2.dbc``) and outputs, and configurations of vehicles."""
